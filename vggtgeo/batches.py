"""Many windows in one program: packed to one shape, solved by one `vmap`."""

from vggtgeo.bundle.batches import pack_batch as pack_batch
from vggtgeo.bundle.batches import solve_batch as solve_batch
