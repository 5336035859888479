"""A map without depth whose points hardly any two keyframes see from different sides: its path may be nothing.

Such a map begins with two views whose points have a median parallax of 2 degrees (`TwoViewStart`). Where the rest of
the run takes that back, the start was wrong: a still stereo camera, both pictures side by side in one, began with
matches of one half in the other, stood still for 20 frames, leapt by 1.45 units and stood still again, all points 240
units away and nine in ten of them under at most 0.35 degrees; it was called good.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models.classical.two_view import TwoViewStart, parallax
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.finding import Finding

LEAST_PARALLAX = TwoViewStart.parallax / 2.0
"""Radians, half of what a start needs: 1 degree. Ten pieces of three clips of which a map came have 7 to 18
(`benchmarks/starts.py`: building-walk and corridor-office, `--every 60`; redkitchen, `--frames 54 --first 8 --every
120`), a start of 101 frames of icl-office with two keyframes 2.7."""
BEST = 0.9
"""Share of the points whose largest parallax is compared with it."""


def check_parallax(slam: Slam) -> list[Finding]:
    """A map without depth in which hardly any point was seen from two sides."""
    if slam.metric:
        return []
    best = best_parallax(slam)
    if best is None or best >= LEAST_PARALLAX:
        return []
    text = (
        f"the map rests on hardly any parallax: {100 * BEST:.0f} % of its points were seen under no more than "
        f"{np.rad2deg(best):.1f} degrees, where turns look like sideways motion; the camera may have stood still"
    )
    return [Finding("parallax", "degraded", text)]


def best_parallax(slam: Slam) -> float | None:
    """Radians that `BEST` of the points do not exceed; None where no two keyframes share any."""
    found = largest_parallax(slam)
    return float(np.quantile(found, BEST)) if len(found) else None


def largest_parallax(slam: Slam) -> np.ndarray:
    """Of each point that two keyframes share: the largest angle between its rays, radians, float64 [n]."""
    keyframes = {keyframe.number: keyframe for keyframe in slam.keyframes}
    largest = {number: np.full(len(keyframe.points.inverse_depth), np.nan) for number, keyframe in keyframes.items()}
    for pair in slam.map.pairs:
        sides = (pair.first, pair.second, pair.points.index_i), (pair.second, pair.first, pair.points.index_j)
        for host, other, indices in sides:
            slots = indices[indices >= 0]
            angles = _parallax(keyframes[host], keyframes[other], slots, slam.intrinsics)
            np.fmax.at(largest[host], slots, angles)
    return np.concatenate([of_one[np.isfinite(of_one)] for of_one in largest.values()] or [np.zeros(0)])


def _parallax(host: Keyframe, other: Keyframe, slots: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """The angle at the host's points, float64 [m]; NaN where their depth is not known."""
    inverse = host.points.inverse_depth[slots]
    inverse = np.where(inverse > 0, inverse, np.nan)
    points = rigid.unproject(host.points.pixels[slots], inverse, np.eye(4), intrinsics)
    return parallax(points, other.pose @ rigid.invert(host.pose))
