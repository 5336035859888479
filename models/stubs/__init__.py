"""Stubs of the five roles: an oracle of a synthetic scene plus a stated error model.

Every number that comes out of them is simulated and has to be called so; each carries `simulated = True`. Answers
depend on the seed and the frames alone, not on the order of calls.

| role | stub | stands for |
|---|---|---|
| `PointMatcher` | `SimulatedMast3r` | MASt3R |
| `LineDetector` | `SimulatedLetr` | LETR |
| `MetricDepth` | `SimulatedMoge` | MoGe-2 |
| `DenseConfidence` | `SimulatedDino` | DINOv3 |
| `WindowGeometry` | `SimulatedVggt` | VGGT |
"""

from vggtgeo.models.stubs.perception import Oracle, SimulatedDino, SimulatedLetr, SimulatedMast3r, SimulatedMoge
from vggtgeo.models.stubs.window import SimulatedVggt

__all__ = ["Oracle", "SimulatedDino", "SimulatedLetr", "SimulatedMast3r", "SimulatedMoge", "SimulatedVggt"]
