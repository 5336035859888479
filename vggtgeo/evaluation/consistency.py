"""Whether covariances tell the truth: the normalised estimation error squared (NEES).

For an error `e` of k numbers and its covariance C, `e' C^-1 e` follows the chi-square law with k degrees of freedom, so
its mean over n independent errors, n times, that with n k. Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation
with Applications to Tracking and Navigation", 2001, section 5.4.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class Consistency:
    """Fields:
    nees: float64 [n], of each error.
    degrees: numbers in an error, what each NEES is on average where the covariances are right.
    low, high: of the mean, the band that right covariances keep it in with the probability `level`, errors being
        independent.
    level: of the band.
    """

    nees: Float[np.ndarray, " n"]
    degrees: int
    low: float
    high: float
    level: float

    @property
    def mean(self) -> float:
        """Above `high`: errors are larger than the covariances say (too sure). Below `low`: smaller."""
        return float(self.nees.mean())

    @property
    def consistent(self) -> bool:
        """Whether the mean lies within the band."""
        return self.low <= self.mean <= self.high

    @property
    def inflation(self) -> float:
        """Standard deviations would have to be larger by this factor for the mean to be what it should."""
        return float(np.sqrt(self.mean / self.degrees))


def consistency(
    errors: Float[np.ndarray, "n k"], covariances: Float[np.ndarray, "n k k"], level: float = 0.95
) -> Consistency:
    """NEES of `errors` by their `covariances`, in the same coordinates and units.

    InputError for other shapes, no error, NaN, a covariance that is not positive definite, or an impossible level.
    """
    if errors.ndim != 2 or not errors.size or covariances.shape != (*errors.shape, errors.shape[1]):
        raise InputError(
            f"`errors` has shape {errors.shape}, `covariances` {covariances.shape}; expected [n, k] and [n, k, k]"
        )
    if not 0 < level < 1:
        raise InputError(f"`level` is {level}; it must lie between 0 and 1")
    if not (np.isfinite(errors).all() and np.isfinite(covariances).all()):
        raise InputError("`errors` or `covariances` has a NaN or an infinity; leave such rows out")
    try:
        factors = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        raise InputError("`covariances` has one that is not positive definite") from None
    white = np.linalg.solve(factors, errors[..., None])[..., 0]
    count, degrees = errors.shape
    low, high = chi2.ppf([0.5 * (1 - level), 0.5 * (1 + level)], count * degrees) / count
    return Consistency((white**2).sum(axis=1), degrees, float(low), float(high), level)
