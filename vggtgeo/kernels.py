"""Robust kernels: how much a large residual counts.

`Square` (none), `Huber`, `Cauchy`, `GemanMcClure`, `Barron` (a family of them); your own is a subclass of
`AbstractKernel`.
"""

from vggtgeo.solvers.kernels import AbstractKernel as AbstractKernel
from vggtgeo.solvers.kernels import Barron as Barron
from vggtgeo.solvers.kernels import Cauchy as Cauchy
from vggtgeo.solvers.kernels import GemanMcClure as GemanMcClure
from vggtgeo.solvers.kernels import Huber as Huber
from vggtgeo.solvers.kernels import Square as Square
