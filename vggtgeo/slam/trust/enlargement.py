"""By what factor each picture is larger than the one before: a phone that changes its lens, a digital zoom.

A camera that walks enlarges what it walks towards by a few percent a frame, as much as in the frames around it; a lens
that is exchanged enlarges the whole picture at once. A map cannot tell: it takes the enlargement for a step forward.

The factor is that of the similarity which most corners agree with (RANSAC). Where few of them could be followed, as
over a large factor, key points are matched by their descriptors. Where depth was measured in both pictures, what it
explains is taken out: whoever came nearer sees everything at a smaller depth, a lens changes no depth.
"""

from __future__ import annotations

import cv2
import numpy as np

from vggtgeo.models.classical import SiftMatcher
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import MOST_NAMED, Finding

MOST = 0.2
"""Logarithm of the factor, its own and beyond that of either neighbour; as many times that as a step takes longer than
most do. Forty frames of a clip have at most 0.06 (`benchmarks/sensor_drift.py`); where blocks of corridor-office are
out of order it is 0.21, which is told as well; a lens of 1.7 times the focal length gives 0.51 to 0.57. The lenses of
phones differ by factors of 1.5 and more."""
LEAST_AGREEING = 20
"""Corners: fewer agree with some similarity where two pictures have nothing in common."""
LEAST_WITH_DEPTH = 10
"""Of the agreeing corners, with depth in both pictures; the median of fewer may be that of edges."""
LEAST_OF_RIGID = 0.35
"""Of the corners that some motion of a camera explains (epipolar geometry), if it was the lens that changed: enlarged
by 1.35, single frames of the four clips have 0.44 to 0.98. A camera that steps round an object finds 20 corners for any
similarity: 0.24 of the rest, in a phone's recording that was called another lens."""
CLOSE = 2.0
"""Pixels of the small image that a corner may be off the similarity: what lies nearer than the rest is farther off."""
_MATCHER = SiftMatcher(count=600, ratio=0.8, refinement=None)


def followed_enlargement(before: np.ndarray, after: np.ndarray, nearer: np.ndarray | None = None) -> float | None:
    """Logarithm of the factor between corners of two pictures, float32 [m, 2] each; None where too few agree.

    nearer: float64 [m], logarithm of each corner's depth in the first picture over that in the second, NaN = unknown.
    """
    if len(before) < LEAST_AGREEING:
        return None
    found, agree = cv2.estimateAffinePartial2D(before, after, method=cv2.RANSAC, ransacReprojThreshold=CLOSE)
    if found is None or np.count_nonzero(agree) < LEAST_AGREEING:
        return None
    factor = float(np.hypot(found[0, 0], found[1, 0]))
    if factor <= 0:
        return None
    if abs(np.log(factor)) > MOST and np.count_nonzero(agree) < LEAST_OF_RIGID * _of_one_motion(before, after):
        return None
    return float(np.log(factor)) - (0.0 if nearer is None else _median_nearer(nearer[agree.ravel() == 1]))


def _of_one_motion(before: np.ndarray, after: np.ndarray) -> int:
    """How many corners one epipolar geometry explains."""
    _, agree = cv2.findFundamentalMat(before, after, cv2.FM_RANSAC, CLOSE, 0.99, 2000)
    return 0 if agree is None else int(np.count_nonzero(agree))


def _median_nearer(nearer: np.ndarray) -> float:
    known = nearer[np.isfinite(nearer)]
    return float(np.median(known)) if len(known) >= LEAST_WITH_DEPTH else 0.0


def matched_corners(
    before: np.ndarray, after: np.ndarray, left_out: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Corners that two grey images uint8 [h, w] share by their descriptors, float32 [m, 2] each; left_out: bool [h, w],
    what the camera carries.
    """
    first, second = (_MATCHER.describe(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)) for image in (before, after))
    matches = _MATCHER.match(first, second)
    start, end = matches.pixels_i.astype(np.float32), matches.pixels_j.astype(np.float32)
    if left_out is not None:
        columns, rows = np.clip(np.rint(end), 0, np.array(left_out.shape[::-1]) - 1).astype(int).T
        kept = ~left_out[rows, columns]
        start, end = start[kept], end[kept]
    return start, end


def beyond_neighbours(enlarged: np.ndarray) -> np.ndarray:
    """How much each step enlarges, and more than the one before and the one after it, float64 [n]: the least of the
    three. Zero where the step says nothing, or neither neighbour does: a large step of the camera looks the same.

    enlarged: float64 [n], as `check_enlargements` takes it.
    """
    enlarged = np.append(np.nan, enlarged[1:])  # the first has none before it
    beside = np.stack([np.append(np.nan, enlarged[:-1]), np.append(enlarged[1:], np.nan)])
    apart = np.nan_to_num(np.abs(enlarged - beside), nan=np.inf).min(0)
    return np.where(np.isfinite(apart), np.minimum(apart, np.abs(enlarged)), 0.0)


def check_enlargements(estimate: Estimate, enlarged: np.ndarray) -> list[Finding]:
    """Steps over which the whole picture grows or shrinks at once.

    enlarged: float64 [n], logarithm of each frame's factor over the one before it, NaN where nothing says.
    """
    if len(enlarged) < 3:
        return []
    apart = beyond_neighbours(enlarged)
    # A camera goes farther where frames are missing.
    taken = np.append(0.0, np.diff(estimate.times))
    most = MOST * np.maximum(taken / max(float(np.median(taken[1:])), 1e-9), 1.0)
    rows = np.flatnonzero(apart > most)
    why = "was the lens changed, or are frames out of order? One focal length is assumed for all"
    if estimate.metric:
        why = "was the lens changed, are frames out of order, or is their depth in another unit?"
    steps = [
        f"frames {estimate.frames[row - 1]} to {estimate.frames[row]}: the whole picture is "
        f"{np.exp(enlarged[row]):.2f} times as large at once"
        for row in rows
    ]
    if len(steps) > MOST_NAMED:
        steps = [f"{steps[0]}, and so on, {len(steps)} times in all"]
    return [Finding("calibration", "degraded", f"{step}: {why}") for step in steps]
