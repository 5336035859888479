"""Constants of robust estimation, and covariances that hold for outliers, clusters and singular matrices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

# `chdtri(degrees, chance)` is what a chi-squared variable exceeds with a chance. `scipy.stats` has plainer names for it
# and its like, but takes a quarter of a second to import.

TUKEY = 4.685
"""Cut of Tukey's biweight in standard deviations: 95 % efficient under Gaussian noise (Holland and Welsch 1977)."""
MAD_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
RARE = 1e-4
"""Chance of a false decision, at the gates that should hardly ever err."""
POSE_GATE = float(chdtri(6, RARE))
"""Gate of a squared Mahalanobis distance between poses, 6 degrees of freedom: one right pose in 10,000 is rejected."""
TINY = float(np.finfo(np.float32).tiny)
"""Smallest normal number in single precision: bounds a divisor whose numerator is zero where it acts."""
ROUNDING = 1e-12
"""Largest rounding errors of a balanced information matrix, as a share of its largest eigenvalue: some thousand
roundings in double precision."""
FEW = 20
"""Fewest samples that a median or a share is taken of: their standard errors are a quarter of the deviation and 0.1."""
REGULARISER = 1e-9
"""Information, 1/m^2 and 1/rad^2, that makes a singular matrix invertible: a standard deviation of 30 km."""


def sigma_by_median(residuals: np.ndarray) -> float:
    """Return the standard deviation of residuals about zero by their median absolute value, [...] not empty."""
    return MAD_SIGMA * float(np.median(np.abs(residuals)))


@dataclass(frozen=True, eq=False)
class ClusteredScore:
    """The score of k parameters at a fit, whose covariance is not their information, as errors are not independent.

    score: float64 [k]. information: [k, k]. clustered: [k, k], covariance of the score, as of `two_way_clustered`.
    """

    score: np.ndarray
    information: np.ndarray
    clustered: np.ndarray

    def gain(self, columns: np.ndarray) -> float:
        """Return the decrease of minus twice the log likelihood that a step along `columns`, [k, c], promises (Rao)."""
        side = columns.T @ self.score
        return float(side @ np.linalg.pinv(columns.T @ self.information @ columns, hermitian=True) @ side)

    def covariance(self, columns: np.ndarray) -> np.ndarray:
        """Return the covariance of the parameters along `columns`, [k, c], float64 [c, c]: `H^-1 C H^-1`."""
        inverse = np.linalg.pinv(columns.T @ self.information @ columns, hermitian=True)
        return np.asarray(inverse @ (columns.T @ self.clustered @ columns) @ inverse + 1e-3 * inverse)

    @property
    def as_one(self) -> float:
        """Number of observations that count as one, in the mean over the parameters with information."""
        information, clustered = np.diag(self.information), np.diag(self.clustered)
        known = information > 0
        return max(float(np.mean(clustered[known] / information[known])) + 1e-3, 1.0) if known.any() else 1.0


def two_way_clustered(scores: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the covariance, float64 [k, k], of the sum of scores [m, k] whose errors are not independent in clusters.

    `sum_first G G^T + sum_second G G^T - sum_o g_o g_o^T`, with the sum `G` of the scores of a cluster, about its mean,
    since what all clusters have in common is the signal (two-way, Cameron, Gelbach and Miller 2011).
    first, second: int [m], cluster of each.
    """

    def squared(of: np.ndarray) -> np.ndarray:
        sums = np.zeros((of.max() + 1, scores.shape[1]))
        np.add.at(sums, of, scores)
        sums -= sums.mean(0)
        return np.asarray(sums.T @ sums)

    return squared(first) + squared(second) - scores.T @ scores


def inverse_information(information: np.ndarray) -> np.ndarray:
    """Return the covariances [..., 6, 6] of information matrices; very large in directions without information."""
    return np.asarray(np.linalg.inv(information + REGULARISER * np.eye(6)))
