"""Which loops have a witness: another loop, between keyframes near by, that says the same.

A loop alone can bend a map as it likes: where the drift is large, its motions have room for it. A camera that passes a
place again sees several of its keyframes again, and these loops agree with each other by the short ways between them,
however large the drift on the long way round (pairwise consistency: Mangelson et al., ICRA 2018).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.tracking.evidence import tangent

NEAR = 8
"""Keyframes, within which another loop must begin and end to be a witness: the ways between are short, so that their
drift is small beside the error of a false loop."""


def witnessed(
    loops: Sequence[MeasuredRelativePose], motions: Sequence[MeasuredRelativePose], gate: float
) -> np.ndarray:
    """Which loops agree with another one, bool [m]; `gate` of the squared Mahalanobis distance between the two."""
    agreed = np.zeros(len(loops), bool)
    if not loops:
        return agreed
    placed = _along(motions)
    step = np.mean([np.linalg.inv(motion.information) for motion in motions], 0) if motions else np.zeros((6, 6))
    ends = np.array([(loop.first, loop.second) for loop in loops])
    for number, loop in enumerate(loops):
        apart = np.abs(ends[number + 1 :] - ends[number])
        for other in (number + 1 + np.flatnonzero((apart <= NEAR).all(1))).tolist():
            if _distance(loop, loops[other], placed, step) < gate:
                agreed[[number, other]] = True
    return agreed


def _distance(
    loop: MeasuredRelativePose, other: MeasuredRelativePose, placed: dict[int, tuple[int, np.ndarray]], step: np.ndarray
) -> float:
    """Squared Mahalanobis distance of a loop from what the other one and the short ways say of it; infinite where the
    ways lead over a gap.
    """
    before, after = _way(placed, other.first, loop.first), _way(placed, loop.second, other.second)
    if before is None or after is None:
        return float("inf")
    # The other loop's motion, by this one: other.first -> loop.first -> loop.second -> other.second.
    expected = after @ loop.pose @ before
    carry = rigid.adjoint(after)
    steps = abs(other.first - loop.first) + abs(other.second - loop.second)
    noise = carry @ np.linalg.inv(loop.information) @ carry.T + np.linalg.inv(other.information) + steps * step
    off = tangent(other.pose @ rigid.invert(expected))
    return float(off @ np.linalg.solve(noise, off))


def _way(placed: dict[int, tuple[int, np.ndarray]], start: int, end: int) -> np.ndarray | None:
    """Motion between two keyframes by odometry."""
    (root, first), (other, second) = (placed.get(number, (number, np.eye(4))) for number in (start, end))
    return second @ rigid.invert(first) if root == other else None


def _along(motions: Sequence[MeasuredRelativePose]) -> dict[int, tuple[int, np.ndarray]]:
    """Root of the tree and pose relative to it of each keyframe."""
    placed: dict[int, tuple[int, np.ndarray]] = {}
    for motion in sorted(motions, key=lambda motion: motion.second):
        root, pose = placed.setdefault(motion.first, (motion.first, np.eye(4)))
        placed[motion.second] = root, rigid.orthonormal(motion.pose @ pose)
    return placed
