"""Consistency of covariances: the normalised estimation error squared (NEES).

For an error `e` of k numbers and its covariance C, `e' C^-1 e` follows the chi-square law with k degrees of freedom, so
its mean over n independent errors, n times, that with n k. Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation
with Applications to Tracking and Navigation", 2001, section 5.4.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, nearest_in_time
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

LEVEL = 0.95


@dataclass(frozen=True, eq=False)
class Consistency:
    """Fields:
    nees: float64 [n], of each error.
    degrees: dimension of an error, the expected NEES for correct covariances.
    low, high: interval of the mean for correct covariances and independent errors, with probability `LEVEL`.
    """

    nees: Float[np.ndarray, " n"]
    degrees: int
    low: float
    high: float

    @property
    def mean(self) -> float:
        """Mean NEES. Above `high` the covariances are too small (overconfident), below `low` too large."""
        return float(self.nees.mean())


def consistency(errors: Float[np.ndarray, "n k"], covariances: Float[np.ndarray, "n k k"]) -> Consistency:
    """Return the NEES of `errors` with their `covariances`, in the same coordinates and units.

    InputError if there is no error. Covariances must be positive definite.
    """
    if not errors.size:
        raise InputError("`errors` is empty; at least one error is needed")
    white = np.linalg.solve(np.linalg.cholesky(covariances), errors[..., None])[..., 0]
    count, degrees = errors.shape
    low, high = chi2.ppf([0.5 * (1 - LEVEL), 0.5 * (1 + LEVEL)], count * degrees) / count
    return Consistency((white**2).sum(axis=1), degrees, float(low), float(high))


def pose_consistency(
    estimate: Trajectory,
    truth: Trajectory,
    place_sigma: Float[np.ndarray, " n"],
    rotation_sigma: Float[np.ndarray, " n"],
    scale: float = 1.0,
) -> tuple[Consistency, Consistency]:
    """Return the NEES of positions and of rotations, for standard deviations relative to the first pose.

    Both trajectories are expressed relative to the first matched pose. Standard deviations (metres, rad) are isotropic.
    scale: factor on the estimate's lengths. Poses with a standard deviation of zero or NaN are left out; InputError if
    none is left.
    """
    rows, others = nearest_in_time(estimate.timestamps, truth.timestamps, MAX_TIME_DIFFERENCE)
    found, true = (
        rigid.invert(poses[:1]) @ poses if len(poses) else poses
        for poses in (estimate.poses[rows], truth.poses[others])
    )
    moved = scale * found[:, :3, 3] - true[:, :3, 3]
    turned = Rotation.from_matrix(found[:, :3, :3].mT @ true[:, :3, :3]).as_rotvec() if len(rows) else moved
    return _by_deviations(moved, place_sigma[rows]), _by_deviations(turned, rotation_sigma[rows])


def _by_deviations(errors: np.ndarray, sigma: np.ndarray) -> Consistency:
    stated = np.isfinite(sigma) & (sigma > 0)
    return consistency(errors[stated], sigma[stated, None, None] ** 2 * np.eye(3))
