"""Compute absolute (ATE) and relative errors (RPE; RTE and RRE of each pair) of matched trajectories, and the NEES.

ATE: distance of the camera centres from the ground truth after alignment.

RPE: for poses `Q` (truth) and `P` (estimate), camera -> world, the error of the pair (i, j) is the motion
`E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`; the length of its translation is the RTE, the angle of its rotation the RRE, and the
RPE is their root mean square. No alignment is needed; a reconstruction of unknown scale must be scaled before.

Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.

NEES, the normalised estimation error squared: for an error `e` of k numbers and its covariance C, `e' C^-1 e` follows
the chi-square law with k degrees of freedom, whose mean is k. Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan,
"Estimation with Applications to Tracking and Navigation", 2001, section 5.4.
"""

from dataclasses import dataclass
from typing import Literal, Self, get_args

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from vggtgeo.evaluation.alignment import VERTICAL, Alignment, Similarity, align
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, nearest_in_time
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_real
from vggtgeo.io.errors import InputError

Unit = Literal["poses", "seconds", "metres"]
UNITS: tuple[Unit, ...] = get_args(Unit)
_MAX_POSES = 2**31
PATH_TOLERANCE = 0.1
"""Maximum relative deviation of overlapping pairs from a delta in seconds or metres; evo's default."""


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of `count` non-negative errors, in their unit; NaN if there are none."""

    rmse: float
    mean: float
    median: float
    maximum: float
    count: int

    @classmethod
    def of(cls, errors: Float[np.ndarray, " n"]) -> Self:
        """Return the statistics of `errors` [n]."""
        if len(errors) == 0:
            return cls(np.nan, np.nan, np.nan, np.nan, 0)
        rmse = float(np.sqrt(np.mean(np.square(errors))))
        return cls(rmse, float(errors.mean()), float(np.median(errors)), float(errors.max()), len(errors))


@dataclass(frozen=True, eq=False)
class AbsoluteError:
    """ATE of a trajectory. errors: float64 [n], metres, by pose. alignment: of the estimate to the ground truth."""

    errors: Float[np.ndarray, " n"]
    alignment: Similarity

    @property
    def statistics(self) -> ErrorStatistics:
        """Statistics of the errors, metres; `rmse` is the ATE."""
        return ErrorStatistics.of(self.errors)


def absolute_error(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment = "se3",
    vertical: tuple[float, float, float] = VERTICAL,
) -> AbsoluteError:
    """Return the ATE of matched trajectories (see `associate`) after an `alignment` (see `align`)."""
    motion = align(estimate, truth, alignment, vertical)
    difference = motion.points(estimate.positions) - truth.positions
    return AbsoluteError(np.linalg.norm(difference, axis=1), motion)


@dataclass(frozen=True, eq=False)
class RelativeError:
    """Errors of the m pairs that are `delta` apart.

    Fields:
        translation: float64 [m], metres (RTE).
        rotation: float64 [m], radians (RRE).
        delta: distance of the two poses of a pair, in `unit`.
        unit: "poses", "seconds", or "metres" of the true path.
    """

    translation: Float[np.ndarray, " m"]
    rotation: Float[np.ndarray, " m"]
    delta: float
    unit: Unit = "poses"

    @property
    def interval(self) -> str:
        """The delta with its unit: `1 pose`, `0.5 seconds`."""
        return f"{self.delta:g} {self.unit[:-1] if self.delta == 1 else self.unit}"

    @property
    def translation_statistics(self) -> ErrorStatistics:
        """Statistics in metres; `mean` is the RTE of the sequence, `rmse` the RPE."""
        return ErrorStatistics.of(self.translation)

    @property
    def rotation_statistics(self) -> ErrorStatistics:
        """Statistics in radians; `mean` is the RRE of the sequence, `rmse` the RPE."""
        return ErrorStatistics.of(self.rotation)


def relative_error(
    estimate: Trajectory, truth: Trajectory, delta: float = 1, all_pairs: bool = False, unit: Unit = "poses"
) -> RelativeError:
    """Return the RPE of matched trajectories (see `associate`) over `delta`, measured along the ground truth.

    Pairs are consecutive, (0, delta), (delta, 2 delta), ..., as in evo; with `all_pairs` they overlap: (0, delta),
    (1, 1 + delta), ... In seconds and metres a pair ends with the first pose at least `delta` later; an overlapping
    pair with the nearest pose, if its distance is within a tenth of delta. For a trajectory shorter than delta the
    arrays are empty. Raises InputError if `delta` or `unit` is invalid.
    """
    first, second = pairs(truth, delta, all_pairs, unit)
    error = _motion(
        _motion(truth.poses[first], truth.poses[second]), _motion(estimate.poses[first], estimate.poses[second])
    )
    return RelativeError(
        translation=np.linalg.norm(error[:, :3, 3], axis=1),
        rotation=rotation_angle(error[:, :3, :3]),
        delta=delta,
        unit=unit,
    )


def pairs(
    trajectory: Trajectory, delta: float, all_pairs: bool = False, unit: Unit = "poses"
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Return the rows of the first and the second pose of each pair; see `relative_error`."""
    if unit not in UNITS:
        raise InputError(f"`unit` must be one of {', '.join(UNITS)}, got {unit!r}")
    check_real("delta", delta)
    if unit == "poses":
        if not (1 <= delta <= _MAX_POSES) or delta != int(delta):
            raise InputError(f"`delta` must be an integer from 1 to {_MAX_POSES}, got {delta}")
        first = np.arange(0, max(len(trajectory) - int(delta), 0), 1 if all_pairs else int(delta))
        return first, first + int(delta)
    if not (np.isfinite(delta) and delta > 0):
        raise InputError(f"`delta` must be more than 0 {unit}, got {delta}")
    if unit == "seconds":
        along = trajectory.timestamps - trajectory.timestamps[:1]
    else:
        steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
        along = np.concatenate([np.zeros(min(len(trajectory), 1)), np.cumsum(steps)])
    return _overlapping(along, delta) if all_pairs else _consecutive(along, delta)


def _consecutive(along: np.ndarray, delta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return consecutive pairs; `along` is the non-decreasing coordinate of each pose, in seconds or metres."""
    delta -= 1e-9 * delta  # `along` has rounding errors: an exact delta must count as reached
    ends, row = [], 0
    while row < len(along):
        ends.append(row)
        row = max(int(np.searchsorted(along, along[row] + delta)), row + 1)
    rows = np.array(ends, int)
    return rows[:-1], rows[1:]


def _overlapping(along: np.ndarray, delta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of each row with the later row whose distance is nearest to `delta`; for ties the first."""
    first = np.arange(max(len(along) - 1, 0))
    after = np.clip(np.searchsorted(along, along[first] + delta), first + 1, len(along) - 1)
    before = np.maximum(np.searchsorted(along, along[np.maximum(after - 1, 0)]), first + 1)
    to_after, to_before = np.abs(along[after] - along[first] - delta), np.abs(along[before] - along[first] - delta)
    second = np.where(to_before <= to_after, before, after)
    near = np.minimum(to_before, to_after) <= PATH_TOLERANCE * delta
    return first[near], second[near]


def rotation_angle(rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Return the angle of each rotation, radians in [0, pi]; accurate near 0 and pi, unlike an arc cosine."""
    skew = rotations - rotations.swapaxes(1, 2)
    sine = np.sqrt(skew[:, 2, 1] ** 2 + skew[:, 0, 2] ** 2 + skew[:, 1, 0] ** 2)
    return np.arctan2(sine, np.trace(rotations, axis1=1, axis2=2) - 1.0)


def _motion(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    transposed = start[:, :3, :3].swapaxes(1, 2)
    motion = np.tile(np.eye(4), (len(start), 1, 1))
    motion[:, :3, :3] = transposed @ end[:, :3, :3]
    motion[:, :3, 3] = np.einsum("nij,nj->ni", transposed, end[:, :3, 3] - start[:, :3, 3])
    return motion


def pose_consistency(
    estimate: Trajectory,
    truth: Trajectory,
    place_sigma: Float[np.ndarray, " n"],
    rotation_sigma: Float[np.ndarray, " n"],
    scale: float = 1.0,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " k"]]:
    """Return the NEES of each position and of each rotation, for standard deviations relative to the first pose.

    The expected value is 3 if the standard deviations are correct, and larger if they are too small. Both trajectories
    are expressed relative to the first matched pose. Standard deviations (metres, rad) are isotropic. scale: factor on
    the estimate's lengths. Poses with a standard deviation of zero or NaN are left out; raises InputError if all are.
    """
    rows, others = nearest_in_time(estimate.timestamps, truth.timestamps, MAX_TIME_DIFFERENCE)
    found, true = (
        rigid.invert(poses[:1]) @ poses if len(poses) else poses
        for poses in (estimate.poses[rows], truth.poses[others])
    )
    moved = scale * found[:, :3, 3] - true[:, :3, 3]
    turned = Rotation.from_matrix(found[:, :3, :3].mT @ true[:, :3, :3]).as_rotvec() if len(rows) else moved
    return _nees(moved, place_sigma[rows]), _nees(turned, rotation_sigma[rows])


def _nees(errors: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the NEES of errors [n, 3] with covariances `sigma`^2 I, without those of unknown standard deviation."""
    known = np.isfinite(sigma) & (sigma > 0)
    if not known.any():
        raise InputError("`place_sigma` and `rotation_sigma` must be positive and finite for at least one matched pose")
    return (errors[known] ** 2).sum(axis=1) / sigma[known] ** 2
