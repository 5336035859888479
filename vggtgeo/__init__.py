"""Dense indoor SLAM with a functional, differentiable bundle adjustment in JAX."""

from vggtgeo import _source_tree as _source_tree  # first: in a source tree it finds `solvers` and `models`
