"""Over how many frames a camera moves on: a video of 60 frames a second shows no parallax from one to the next.

The check of depth against motion compares frames so many apart. Its thresholds were measured on clips that move by 0.03
(HoloLens) and 0.007 (redkitchen) of the scene's depth a frame; a slow hand at 30 frames a second moves by 0.0025, and
over the same number of frames no corner is triangulated, so that nothing was tested and nothing was told. The camera is
not asked of frames that far apart: what the sensor's depth has of errors that are no noise moves corners as a wrong
focal length does (13 % of redkitchen's, seven standard deviations).
"""

from __future__ import annotations

import numpy as np

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence

SPAN = 6
"""Frames, the longest that are compared at a pace of 1."""
PARALLAX = 0.04
"""Of the depth: the median motion over the longest span. A corner followed to half a pixel is then known to 3 % at a
focal length of 500 pixels."""
MOST = 8
"""Corners do not live longer than some fifty frames."""


def pace(estimate: Estimate, evidence: Evidence) -> int:
    """The factor, 1 to `MOST`, on numbers of frames to compare; 1 without depth, or where the camera never gets there.

    evidence: of all frames of the estimate.
    """
    depth = np.array([noted.depth_median for noted in evidence])
    for factor in range(1, MOST + 1):
        apart = SPAN * factor
        if apart >= len(evidence):
            break
        moved = np.linalg.norm(estimate.centres[apart:] - estimate.centres[:-apart], axis=1) / depth[:-apart]
        moved = moved[np.isfinite(moved) & estimate.tracked[apart:] & estimate.tracked[:-apart]]
        if len(moved) and np.median(moved) >= PARALLAX:
            return factor
    return 1
