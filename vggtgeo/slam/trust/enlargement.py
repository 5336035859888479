"""By what factor each picture is larger than the one before: a phone that changes its lens, a digital zoom.

A camera that walks enlarges what it walks towards by a few percent a frame, as much as in the frames around it; a lens
that is exchanged enlarges the whole picture at once. A map cannot tell: it takes the enlargement for a step forward.

The factor is that of the similarity which most corners agree with (RANSAC). Where few of them could be followed, as
over a large factor, key points are matched by their descriptors.
"""

from __future__ import annotations

import cv2
import numpy as np

from vggtgeo.models.classical import SiftMatcher
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import Finding

MOST = 0.2
"""Logarithm of the factor, its own and beyond that of either neighbour; as many times that as a step takes longer than
most do. With one lens it is at most 0.063 in four clips, 0.094 at
1.7 frames a second, 0.131 at one, and 0.207 where blocks of frames are out of order (corridor-office: told as well);
where a picture is enlarged at once by 1.25 it is 0.21 to 0.25, by 1.7 0.51 to 0.54. The lenses of phones differ by
factors of 1.5 and more."""
LEAST_AGREEING = 20
"""Corners: fewer agree with some similarity where two pictures have nothing in common."""
CLOSE = 2.0
"""Pixels of the small image that a corner may be off the similarity: what lies nearer than the rest is farther off."""
_MATCHER = SiftMatcher(count=600, ratio=0.8, refinement=None)


def followed_enlargement(before: np.ndarray, after: np.ndarray) -> float | None:
    """Logarithm of the factor between corners of two pictures, float32 [m, 2] each; None where too few agree."""
    if len(before) < LEAST_AGREEING:
        return None
    found, agree = cv2.estimateAffinePartial2D(before, after, method=cv2.RANSAC, ransacReprojThreshold=CLOSE)
    if found is None or np.count_nonzero(agree) < LEAST_AGREEING:
        return None
    factor = float(np.hypot(found[0, 0], found[1, 0]))
    return float(np.log(factor)) if factor > 0 else None


def matched_enlargement(before: np.ndarray, after: np.ndarray, left_out: np.ndarray | None) -> float | None:
    """The same by descriptors, from grey images uint8 [h, w]; left_out: bool [h, w], what the camera carries."""
    first, second = (_MATCHER.describe(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)) for image in (before, after))
    matches = _MATCHER.match(first, second)
    start, end = matches.pixels_i.astype(np.float32), matches.pixels_j.astype(np.float32)
    if left_out is not None:
        columns, rows = np.clip(np.rint(end), 0, np.array(left_out.shape[::-1]) - 1).astype(int).T
        kept = ~left_out[rows, columns]
        start, end = start[kept], end[kept]
    return followed_enlargement(start, end)


def check_enlargements(estimate: Estimate, enlarged: np.ndarray) -> list[Finding]:
    """Steps over which the whole picture grows or shrinks at once.

    enlarged: float64 [n], logarithm of each frame's factor over the one before it, NaN where nothing says.
    """
    if len(enlarged) < 3:
        return []
    enlarged = np.append(np.nan, enlarged[1:])  # the first has none before it
    beside = np.stack([np.append(np.nan, enlarged[:-1]), np.append(enlarged[1:], np.nan)])
    # Where neither neighbour says anything, a large step of the camera looks the same.
    apart = np.nan_to_num(np.abs(enlarged - beside), nan=np.inf).min(0)
    # A camera goes farther where frames are missing.
    taken = np.append(0.0, np.diff(estimate.times))
    most = MOST * np.maximum(taken / max(float(np.median(taken[1:])), 1e-9), 1.0)
    found = []
    for row in np.flatnonzero(np.isfinite(apart) & (apart > most) & (np.abs(enlarged) > most)):
        first, last = int(estimate.frames[row - 1]), int(estimate.frames[row])
        text = (
            f"frames {first} to {last}: the whole picture is {np.exp(enlarged[row]):.2f} times as large at once: was "
            "the lens changed, or are frames out of order? One focal length is assumed for all"
        )
        found.append(Finding("calibration", "degraded", text))
    return found
