"""Accumulated odometry between any two keyframes, with a bound of its covariance.

Motion i, `T_i = M_i T_{i-1}`, has a left tangent error of covariance `S_i`: the stated one plus systematic errors. To
first order the errors of the way from keyframe a to b add up in the camera of b: `e = sum_i A_i e_i` with `A_i = Ad(T_b
T_i^-1)`. The correlation between motions is unknown, since calibration, shutter and scene are the same for all. For any
correlation, `cov(e) <= n sum_i A_i S_i A_i^T` for n motions (Cauchy-Schwarz), with equality if all errors are equal. So
the standard deviation grows with the length of the way, not with its root.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import rigid
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.tracking.pose_fusion import with_systematic


class Way(NamedTuple):
    """Motions camera `start` -> camera `end` by odometry, one row a pair of keyframes.

    pose: float64 [m, 4, 4]. spread: sum of the motions' covariances in the camera of `end`, float64 [m, 6, 6]. motions:
    number on the way, int [m]; times `spread` it bounds the covariance. connected: bool [m]; where False the other
    values are invalid.
    """

    pose: np.ndarray
    spread: np.ndarray
    motions: np.ndarray
    connected: np.ndarray


@dataclass(frozen=True, eq=False)
class Odometry:
    """A forest of tracked motions. parent: int [n], -1 at a root. poses: relative to the root, float64 [n, 4, 4].

    spread: sum of covariances from the root, right tangent of `poses`, float64 [n, 6, 6]. root, depth: int [n].
    """

    parent: np.ndarray
    poses: np.ndarray
    spread: np.ndarray
    root: np.ndarray
    depth: np.ndarray

    @classmethod
    def of(cls, motions: Iterable[MeasuredRelativePose], keyframes: int, *, systematic: bool = True) -> Self:
        """Build the forest from the first motion to each keyframe from an earlier one; others are ignored.

        systematic: whether to add systematic errors to the stated ones.
        """
        parent, depth = np.full(keyframes, -1), np.zeros(keyframes, int)
        root = np.arange(keyframes)
        poses, spread = np.tile(np.eye(4), (keyframes, 1, 1)), np.zeros((keyframes, 6, 6))
        for motion in sorted(motions, key=lambda motion: motion.second):
            before, here = motion.keyframes
            if before >= here or parent[here] >= 0:
                continue
            parent[here], root[here], depth[here] = before, root[before], depth[before] + 1
            poses[here] = rigid.orthonormal(motion.pose @ poses[before])
            # As right tangents of the pose, errors of the motions on the way add up without further transport.
            carry = rigid.adjoint(rigid.invert(poses[here]))
            stated = motion.information
            information = with_systematic(stated, motion.pose) if systematic else stated
            spread[here] = spread[before] + carry @ np.linalg.inv(information) @ carry.T
        return cls(parent, poses, spread, root, depth)

    def way(self, start: np.ndarray, end: np.ndarray) -> Way:
        """Return the ways from each keyframe of `start` to that of `end`, int [m] each."""
        connected = self.root[start] == self.root[end]
        meeting = self._meeting(np.where(connected, start, 0), np.where(connected, end, 0))
        pose = self.poses[end] @ rigid.invert(self.poses[start])
        carry = rigid.adjoint(self.poses[end])
        # The way between two nodes of a tree leaves out what both share: the way from the root to their meeting point.
        spread = carry @ (self.spread[start] + self.spread[end] - 2 * self.spread[meeting]) @ carry.mT
        motions = self.depth[start] + self.depth[end] - 2 * self.depth[meeting]
        return Way(pose, spread, motions, connected)

    def distances(self, measured: Sequence[MeasuredRelativePose], growth: float = np.inf) -> np.ndarray:
        """Return the squared Mahalanobis distance of each measured motion from odometry, 6 degrees of freedom, float64
        [m].

        NaN if the ends are not connected. growth: factor on the sum of the motions' covariances, at most their number.
        """
        start, end = np.array([motion.keyframes for motion in measured], int).reshape(-1, 2).T
        way = self.way(start, end)
        noise = np.linalg.inv(np.array([motion.information for motion in measured]).reshape(-1, 6, 6))
        poses = np.array([motion.pose for motion in measured]).reshape(-1, 4, 4)
        covariance = noise + np.minimum(way.motions, growth)[:, None, None] * way.spread
        return np.where(way.connected, squared_distance(poses, way.pose, covariance), np.nan)

    def _meeting(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the keyframe at which the ways to the root meet; a parent has a smaller number than its children."""
        first, second = first.copy(), second.copy()
        while np.any(apart := first != second):
            later = apart & (first > second)
            first[later] = self.parent[first[later]]
            later = apart & ~later
            second[later] = self.parent[second[later]]
        return first


def squared_distance(found: np.ndarray, expected: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the squared Mahalanobis distance of motions float64 [m, 4, 4] from others, 6 degrees of freedom, float64
    [m].

    covariance: of both together, left tangent, translation first, float64 [m, 6, 6].
    """
    off = found @ rigid.invert(expected)
    turned = Rotation.from_matrix(off[:, :3, :3]).as_rotvec() if len(off) else np.zeros((0, 3))
    error = np.concatenate([off[:, :3, 3], turned], 1)
    return np.asarray(np.einsum("mi,mi->m", error, np.linalg.solve(covariance, error[..., None])[..., 0]))
