"""The depth images alone: frozen while the picture moves, or of a size that no room has.

- Every sensor has noise, and a camera that moves sees other depths: a depth image that is to the last digit the one
  before, while the corners moved by more than `MOVED` pixels, is the same file again.
- Frames of indoor RGB-D clips have median depths between 0.6 and 4 m (redkitchen 1.7, corridor-office 2.4,
  building-walk 2.3, TUM's desks 1 to 1.5); sensors for rooms begin at 0.2 to 0.5 m and end at 8 to 10. A clip whose
  median is outside `PLAUSIBLE` was most likely read in a wrong unit. So was one that shows nothing farther than
  `SMALLEST_ROOM`: of each 40 frames of the four clips the farthest twentieth of the depths begins at 2.3 m or more. A
  constant factor between those limits cannot be seen: the world of the run is then as much larger or smaller, and
  agrees with itself.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from vggtgeo.datasets.check import PLAUSIBLE
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, flow
from vggtgeo.slam.trust.finding import Finding, spans

MOVED = 2.0
LEAST_CHANGED = 0.02
"""Share of pixels of a depth image that a moving camera changes at least, quantisation to 5 cm included (0.7)."""
LEAST_FRAMES = 3
SLOWER = 4
"""Pictures in a row that repeat a depth image: a depth camera of a fifth of their rate, and none is slower. What is
repeated is not used (`with_own_depth`), and no fault.
"""
MOSTLY = 0.8
"""Share of the frames: where as many show one depth image while the picture moves, poses that agree with it were made
by it. 40 frames of building-walk, all of them 1 m away, 34 cm off, agreed with themselves and were called good."""
NEAREST = 0.2
"""Metres: at most a tenth of the corners is nearer to a sensor for rooms."""
SENSED = 0.2, 8.0
"""Metres that `SensorDepth` takes: a map whose depth is elsewhere has none, and would be called good without a word."""
SMALLEST_ROOM = 1.0
"""Metres: of the depths at corners, over the whole run, more than a twentieth is farther."""


def check_frozen(estimate: Estimate, evidence: Evidence, harmless: Callable[[int, int], bool]) -> list[Finding]:
    """Depth images that are repeated while the picture moves, where they were used.

    harmless: whether depth and motion agree all the same between two rows, as they do where the camera hardly moves:
    then it marks the segment only, if most frames have a depth image of their own.
    """
    if not estimate.metric:  # all beyond its range, say, which is the same all the time
        return []
    moved = np.array([0.0, *(flow(a, b) for a, b in pairwise(evidence))])
    with np.errstate(invalid="ignore"):
        changed = np.array([frame.depth_changed for frame in evidence])
        frozen = (changed < LEAST_CHANGED) & (moved > MOVED)
    for first, last in spans(changed == 0):
        if last - first < SLOWER:
            frozen[first : last + 1] = False
    if np.count_nonzero(frozen) < LEAST_FRAMES:
        return []
    own = bool(np.mean(frozen) < MOSTLY)
    found = []
    for first, last in spans(frozen, join=3):
        start, end = evidence[max(first - 1, 0)].frame, evidence[last].frame
        text = f"frames {start} to {end}: the depth image stays the same while the picture moves"
        local = own and harmless(first, last)
        found.append(Finding("frozen depth", "degraded", text, start, end, scale=not local, local=local))
    return found


def check_range(estimate: Estimate, evidence: Evidence) -> list[Finding]:
    """A depth that no room has: most likely a wrong unit."""
    medians = np.array([frame.depth_median for frame in evidence])
    medians = medians[np.isfinite(medians)]
    if not len(medians):
        return []
    middle = float(np.median(medians))
    if not estimate.metric:
        if SENSED[0] <= middle <= SENSED[1]:
            return []
        text = (
            f"the median depth is {middle:.3g} m, where no sensor for rooms sees: it was not used, and the scale stays "
            "free; is the unit of the depth images right?"
        )
        return [Finding("depth range", "degraded", text)]
    corners = np.concatenate([frame.depth for frame in evidence])
    corners = corners[np.isfinite(corners)]
    # A hole counts as far: where a sensor ends at 1.7 m, say, what is left of a wide view is what is near.
    with_depth = [np.where(np.isfinite(d), d, np.inf) for d in (f.depth for f in evidence) if np.isfinite(d).any()]
    near = float(np.quantile(np.concatenate(with_depth), 0.1)) if with_depth else NEAREST
    if near < NEAREST:
        text = (
            f"a tenth of the corners is within {near:.2g} m, nearer than sensors for rooms can see: is the unit right?"
        )
        return [Finding("depth range", "degraded", text, scale=True)]
    far = float(np.quantile(corners, 0.95)) if len(corners) else SMALLEST_ROOM
    if PLAUSIBLE[0] <= middle and far < SMALLEST_ROOM:
        text = f"of the depths 19 in 20 are within {far:.2g} m, as in no room: is the unit of the depth images right?"
        return [Finding("depth range", "degraded", text, scale=True)]
    if PLAUSIBLE[0] <= middle <= PLAUSIBLE[1]:
        return []
    text = (
        f"the median depth is {middle:.3g} m; indoors it is {PLAUSIBLE[0]} to {PLAUSIBLE[1]} m: is the unit of the "
        "depth images right?"
    )
    return [Finding("depth range", "degraded", text, scale=True)]
