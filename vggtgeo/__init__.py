"""Dense indoor SLAM with a functional, differentiable bundle adjustment in JAX.

`import vggtgeo as vg` is all a user needs: what runs and solves is here, the rest in groups (`vg.terms`, `vg.cameras`,
`vg.kernels`, `vg.settings`, `vg.analysis`, `vg.batches`, `vg.callbacks`, `vg.data`, `vg.learning`). `__init__.pyi` has
the table. Each name is loaded when it is first asked for, so that `vggtgeo --help` imports neither JAX nor OpenCV.
"""

import lazy_loader

from vggtgeo import _source_tree as _source_tree  # first: in a source tree it finds `solvers` and `models`

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
