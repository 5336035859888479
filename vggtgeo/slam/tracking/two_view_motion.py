"""A frame's motion from a keyframe whose key points have no depth yet: where the camera turns so fast that two frames
share much, and three share nothing.

The essential matrix of the matches gives the rotation and the direction of the translation. Its length is that of the
depths that are known, few as they are, and of the motion so far: the mean of both by information, over the logarithm.
The information of the motion is that of the matches, the depth of each eliminated: with the rows `J` of a projection
over the left tangent and its column `c` over the inverse depth of the point, `sum J^T (I - c c^T / c^T c) J / sigma^2`.
It says nothing of the length, so that of the length is added. Where all points are far away it says little of the
translation: that goes on as before (`fusion.drawn_to`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.models.roles import GeometryResult, InitialGeometry, PointMatches
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.tracking.evidence import STEP_GROWTH

LEAST_KNOWN = 3
"""Depths that tell a length: the median of fewer is any of them."""


@dataclass(frozen=True, eq=False)
class TwoViewMotion:
    """Keyframe camera -> frame camera, float64 [4, 4], its information [6, 6] over the left tangent, translation first,
    and which of the matches agree, bool [n]. points: float64 [n, 3] in the keyframe, NaN where not known.
    """

    motion: np.ndarray
    information: np.ndarray
    inliers: np.ndarray
    points: np.ndarray


def two_view_motion(
    keyframe: Keyframe,
    matches: PointMatches,
    length: float,
    intrinsics: np.ndarray,
    geometry: InitialGeometry,
    sigma: float,
) -> TwoViewMotion | None:
    """The motion to a frame by its matches with a keyframe; None where they do not determine one.

    length: of the motion by the motion so far. sigma: standard deviation of a match, pixels.
    """
    guess = geometry.start(matches.pixels_i, matches.pixels_j, intrinsics)
    if guess.result not in (GeometryResult.SUCCESS, GeometryResult.LOW_PARALLAX):
        return None
    if not (length > 0 and guess.inliers.any()):
        return None
    length, spread = _length(keyframe, matches.index_i, guess.points, guess.inliers, length)
    motion = guess.pose.copy()
    motion[:3, 3] *= length
    points = length * guess.points
    information = _without_length(points[guess.inliers], motion, intrinsics) / sigma**2
    along = np.append(motion[:3, 3], np.zeros(3))
    information += np.outer(along, along) / (spread * length * length) ** 2
    return TwoViewMotion(motion, information, guess.inliers, points)


def usual_step(keyframes: tuple[Keyframe, ...], frame: int) -> float:
    """Length of the motion from the newest keyframe to a frame, at the speed between the newest two."""
    if len(keyframes) < 2:
        return 0.0
    before, last = keyframes[-2:]
    apart = np.linalg.norm(rigid.centre(last.pose) - rigid.centre(before.pose))
    return float(apart) * (frame - last.frame) / max(last.frame - before.frame, 1)


def _length(
    keyframe: Keyframe, slots: np.ndarray, points: np.ndarray, inliers: np.ndarray, expected: float
) -> tuple[float, float]:
    """The length of a motion whose points [n, 3] are known in its unit, and the deviation of its logarithm."""
    known = inliers & keyframe.points.determined[slots]
    if np.count_nonzero(known) < LEAST_KNOWN:
        return expected, STEP_GROWTH
    logs = -np.log(keyframe.points.inverse_depth[slots[known]] * points[known, 2])
    middle = float(np.median(logs))
    # Standard error of a median: 1.25 sigma / sqrt(n), sigma from the median absolute deviation.
    error = 1.25 * 1.48 * float(np.median(np.abs(logs - middle))) / np.sqrt(len(logs))
    weights = np.array([STEP_GROWTH, max(error, 1e-3)]) ** -2
    mean = weights @ [np.log(expected), middle] / weights.sum()
    return float(np.exp(mean)), float(weights.sum() ** -0.5)


def _without_length(points: np.ndarray, motion: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Information [6, 6] of matches of a pixel's noise about a motion, the depths of their points eliminated."""
    turned = points @ motion[:3, :3].T
    rows = np.stack(pinhole.projection_rows(turned + motion[:3, 3], intrinsics))  # [2, 6, n]
    column = np.einsum("rkn,nk->rn", rows[:, :3], turned)
    reduced = rows - column[:, None] * (np.einsum("rkn,rn->kn", rows, column) / np.sum(column**2, 0))[None]
    return np.asarray(np.einsum("rkn,rln->kl", reduced, reduced))
