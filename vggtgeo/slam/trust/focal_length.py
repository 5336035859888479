"""Without measured depth and without a camera that was given: do the images determine the focal length at all?

A camera that does not turn says nothing of it: stretched along its axis by any factor, a world gives the same pictures
to a focal length that is longer by that factor, and the motion is stretched with it. A film that glides straight on
turns by a degree or two, by chance or by its stabiliser; what its adjustment finds then is the sum of small errors. The
path is right, and the map is not: a loft, filmed with some 800 px, was found with 2224, and called good.

So the information of the matches on one focal length of a stretch of keyframes is asked, poses and depths free.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.slam.global_map.pose_uncertainty import SHARED_ERRORS
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.calibration import MOST_FOCAL
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.zoom import (
    PRIOR,
    UNIT_HELD,
    Unknowns,
    linearise,
    matches_among,
    one_focal_length,
    short_stretches,
)

MOST_SIGMA = MOST_FOCAL / 2
"""Standard deviation of the logarithm: with more, the focal length may be off by what is told of one that was given, at
two of them. The loft has 0.12. Right maps whose camera nobody gave have 0.001 to 0.016 where they know it best:
thirteen pieces of 30 to 101 frames of four clips, 50 stills of a fox, three rooms that phones filmed. Simulated, a
camera that goes 1 m into a room 3 to 6 m deep has 0.08 if it turns by one degree, 0.04 by two, 0.002 by thirty. A
stretch that knows it holds the others."""


def check_focal_length(slam: Slam) -> list[Finding]:
    """Whether no stretch of the map knows the focal length that the run found."""
    if slam.metric or slam.camera.calibrated:
        return []
    asked = False
    for stretch in short_stretches(slam):
        sigma = focal_sigma(slam, stretch)
        if sigma is not None and sigma <= MOST_SIGMA:
            return []
        asked = asked or sigma is not None
    if not asked:
        return []
    text = (
        f"nobody gave the camera, and the images hardly determine its focal length, {slam.intrinsics[0]:.0f} px: the "
        "camera hardly turned where it moved; the map may be stretched along its view; give the intrinsics"
    )
    return [Finding("calibration", "degraded", text)]


def focal_sigma(slam: Slam, stretch: np.ndarray) -> float | None:
    """Standard deviation of the logarithm of one focal length of these keyframes; None where there are too few matches.

    stretch: int [n], places in `slam.keyframes`.
    """
    seen = matches_among(slam, stretch)
    if seen is None:
        return None
    count = len(stretch)
    poses = np.array([slam.keyframes[place].pose for place in stretch], np.float64)
    linear = linearise(seen, Unknowns(poses, np.zeros(count), seen.depth))
    frames, own = linear.frames.copy(), np.arange(6, 7 * count, 7)
    frames[own, own] -= 1 / PRIOR**2  # the matches alone are asked
    shared = one_focal_length(count)
    information = (shared.T @ (frames - (linear.both.T / linear.depths) @ linear.both) @ shared)[6:, 6:]
    variance = np.linalg.inv(information + UNIT_HELD * np.eye(len(information)))[-1, -1]
    return float(np.sqrt(SHARED_ERRORS * variance) * linear.noise)
