"""Relative pose errors (RPE; RTE and RRE pair by pair): how well the motion over a stated delta is known.

For poses `Q` (truth) and `P` (estimate), camera -> world, the error of the pair (i, j) is the motion
`E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`; its translation's length is the RTE, its rotation's angle the RRE, and the
RPE is their root mean square. No alignment is needed; a reconstruction without scale must be scaled before.
Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vggtgeo.evaluation.statistics import ErrorStatistics
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class RelativeError:
    """Errors of the m pairs that lie `delta` poses apart.

    Fields:
        translation: float64 [m], metres (RTE).
        rotation: float64 [m], radians (RRE).
        direction: float64 [m], radians between the two translation directions, which knows no scale; NaN
        where
            either camera stood still.
        delta: poses between the two of a pair.
    """

    translation: Float[np.ndarray, " m"]
    rotation: Float[np.ndarray, " m"]
    direction: Float[np.ndarray, " m"]
    delta: int

    @property
    def translation_statistics(self) -> ErrorStatistics:
        """In metres; `mean` is the RTE of the sequence, `rmse` the RPE."""
        return ErrorStatistics.of(self.translation)

    @property
    def rotation_statistics(self) -> ErrorStatistics:
        """In radians; `mean` is the RRE of the sequence, `rmse` the RPE."""
        return ErrorStatistics.of(self.rotation)


def relative_error(estimate: Trajectory, truth: Trajectory, delta: int = 1, all_pairs: bool = False) -> RelativeError:
    """RPE of matched trajectories (see `associate`) over `delta` poses.

    Pairs are consecutive, (0, delta), (delta, 2 delta), ..., as evo has it; with `all_pairs` they overlap:
    (0, delta), (1, 1 + delta), ... No pair (a trajectory shorter than delta) gives empty arrays. InputError
    where the two differ in length or `delta` is below 1.
    """
    if len(estimate) != len(truth):
        raise InputError(
            f"`estimate` has {len(estimate)} poses, `truth` {len(truth)}; match them first with `associate`"
        )
    if delta < 1:
        raise InputError(f"`delta` is {delta}; it must be at least 1 pose")
    first = np.arange(0, max(len(estimate) - delta, 0), 1 if all_pairs else delta)
    estimated = _motion(estimate.poses[first], estimate.poses[first + delta])
    true = _motion(truth.poses[first], truth.poses[first + delta])
    error = _motion(true, estimated)
    return RelativeError(
        translation=np.linalg.norm(error[:, :3, 3], axis=1),
        rotation=rotation_angle(error[:, :3, :3]),
        direction=_angle_between(estimated[:, :3, 3], true[:, :3, 3]),
        delta=delta,
    )


def rotation_angle(rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """The angle of each rotation, radians in [0, pi]; accurate at both ends, where an arc cosine is not."""
    skew = rotations - rotations.swapaxes(1, 2)
    sine = np.sqrt(skew[:, 2, 1] ** 2 + skew[:, 0, 2] ** 2 + skew[:, 1, 0] ** 2)
    return np.arctan2(sine, np.trace(rotations, axis1=1, axis2=2) - 1.0)


def _motion(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    transposed = start[:, :3, :3].swapaxes(1, 2)
    motion = np.tile(np.eye(4), (len(start), 1, 1))
    motion[:, :3, :3] = transposed @ end[:, :3, :3]
    motion[:, :3, 3] = np.einsum("nij,nj->ni", transposed, end[:, :3, 3] - start[:, :3, 3])
    return motion


def _angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    sine, cosine = np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)
    moving = (np.linalg.norm(a, axis=1) > 0) & (np.linalg.norm(b, axis=1) > 0)
    return np.where(moving, np.arctan2(sine, cosine), np.nan)
