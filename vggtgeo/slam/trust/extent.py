"""Without metric depth a path is known up to its scale, and a path that is no longer than its own error has no shape.

A camera that turns in place gives points hardly any parallax: their distances are guesses, the images agree with
them, and what looks like a path is the error of the poses.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import Finding

MOST_UNKNOWN = 0.55
"""Median standard deviation of the places, of their spread. Without depth, 240 frames of freiburg1/rpy, which turns
within 10 cm, have 0.69 (0.28 before `SHARED_ERRORS`, times its root) and are 3.4 cm off; icl-office, which moves as
little but sideways, 0.43 and 0.5 cm; corridor-office and the rendered rooms 0.05."""


def check_extent(estimate: Estimate, sigma: np.ndarray | None) -> list[Finding]:
    """Is the path of free scale longer than its error?

    sigma: float64 [m], standard deviations of the places, in the unit of the map, NaN = unknown; None: none is known.
    """
    if estimate.metric or sigma is None or not np.isfinite(sigma).any():
        return []
    centres = estimate.centres[estimate.tracked]
    spread = float(np.sqrt(np.mean(np.sum((centres - centres.mean(0)) ** 2, 1))))
    share = float(np.nanmedian(sigma)) / max(spread, 1e-12)
    if share < MOST_UNKNOWN:
        return []
    text = (
        f"the places are known to {min(100 * share, 100):.0f} % of their spread only: the camera turns more than it "
        "moves, and without depth the path has little shape"
    )
    return [Finding("extent", "degraded", text)]
