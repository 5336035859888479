"""Motion of a frame from a keyframe whose key points have no depth yet.

This happens in turns so fast that points are seen in two frames only. The essential matrix of the matches gives the
rotation and the direction of the translation. Its length is taken from the motion so far, since too few depths are
known to measure it.

The information of the motion is that of the matches with depths eliminated: with the rows `J` of a projection over the
left tangent and its column `c` over the inverse depth of the point, `sum J^T (I - c c^T / c^T c) J / sigma^2`. It has
no information about the length, so that of the prior is added. If all points are far away the translation is weakly
constrained and follows the motion prior (`pose_fusion.fused_with_prior`).

Depths may also be known and wrong: after a fast turn with little parallax, points with wrong depths agree on a wrong
motion, in the worst case the opposite one. The epipolar lines of all matches, with known depth or without, then
contradict it (`explains_more`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.models.roles import GeometryResult, InitialGeometry, PointMatches
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.tracking.pose_acceptance import STEP_GROWTH

EXPLAINED_GATE = 2.0
"""Largest distance of a match from its epipolar line, pixels: four standard deviations of a key point."""
DECISIVE = float(chdtri(1, 1e-6))
"""Statistic above which one of two motions explains more matches than the other beyond chance. Tried on each frame of
a run, so that a level of 1e-6 is one false decision in a million frames."""


@dataclass(frozen=True, eq=False)
class TwoViewMotion:
    """Keyframe camera -> frame camera, float64 [4, 4], its information [6, 6] over the left tangent, translation first,
    and which matches are inliers, bool [n]. points: float64 [n, 3] in the keyframe, NaN if unknown.
    """

    motion: np.ndarray
    information: np.ndarray
    inliers: np.ndarray
    points: np.ndarray


def two_view_motion(
    matches: PointMatches, length: float, intrinsics: np.ndarray, geometry: InitialGeometry, sigma: float
) -> TwoViewMotion | None:
    """Return the motion from a keyframe to a frame by their matches; None if it is not determined.

    length: of the motion, from the motion so far. sigma: standard deviation of a match, pixels.
    """
    guess = geometry.start(matches.pixels_i, matches.pixels_j, intrinsics)
    if guess.result not in (GeometryResult.SUCCESS, GeometryResult.LOW_PARALLAX):
        return None
    if not (length > 0 and guess.inliers.any()):
        return None
    motion = guess.pose.copy()
    # The essential matrix gives a unit translation.
    motion[:3, 3] *= length
    points = length * guess.points
    information = _without_length(points[guess.inliers], motion, intrinsics) / sigma**2
    along = np.append(motion[:3, 3], np.zeros(3))
    # The prior of the length: its gradient by the translation is the unit vector `t / |t|`, and its sigma `STEP_GROWTH
    # |t|`.
    information += np.outer(along, along) / (STEP_GROWTH * length * length) ** 2
    return TwoViewMotion(motion, information, guess.inliers, points)


def explains_more(motion: np.ndarray, other: np.ndarray, matches: PointMatches, intrinsics: np.ndarray) -> bool:
    """Return whether a motion explains more matches than another does, beyond chance (McNemar, 1947).

    Only matches that one of both explains tell them apart; if they are equally good, each of these has the same chance
    to be explained by either.
    """
    ours, theirs = (_explained(one, matches, intrinsics) for one in (motion, other))
    gained, lost = np.count_nonzero(ours & ~theirs), np.count_nonzero(theirs & ~ours)
    return bool(gained > lost and (gained - lost) ** 2 > DECISIVE * (gained + lost))


def may_explain_more(motion: np.ndarray, matches: PointMatches, intrinsics: np.ndarray) -> bool:
    """Return whether so many matches contradict a motion that another one could explain more beyond chance."""
    return bool(np.count_nonzero(~_explained(motion, matches, intrinsics)) > DECISIVE)


def _explained(motion: np.ndarray, matches: PointMatches, intrinsics: np.ndarray) -> np.ndarray:
    return pinhole.epipolar_distance(matches.pixels_i, matches.pixels_j, motion, intrinsics) < EXPLAINED_GATE


def usual_step(keyframes: tuple[Keyframe, ...], frame: int) -> float:
    """Return the length of the motion from the newest keyframe to a frame, at the speed between the newest two."""
    if len(keyframes) < 2:
        return 0.0
    before, last = keyframes[-2:]
    apart = np.linalg.norm(rigid.centre(last.pose) - rigid.centre(before.pose))
    return float(apart) * (frame - last.frame) / max(last.frame - before.frame, 1)


def _without_length(points: np.ndarray, motion: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return the information [6, 6] of matches with a noise of one pixel about a motion, depths eliminated."""
    turned = points @ motion[:3, :3].T
    rows = np.stack(pinhole.projection_rows(turned + motion[:3, 3], intrinsics))  # [2, 6, n]
    column = np.einsum("rkn,nk->rn", rows[:, :3], turned)
    # Schur complement of one scalar: the projection of the rows off the direction in which depth moves the pixel.
    reduced = rows - column[:, None] * (np.einsum("rkn,rn->kn", rows, column) / np.sum(column**2, 0))[None]
    return np.asarray(np.einsum("rkn,rln->kl", reduced, reduced))
