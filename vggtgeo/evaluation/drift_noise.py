"""Errors of a trajectory as white noise upon a drift: the covariance that fits them, and what it makes white.

The error of pose i is `d_i + v_i`, the drift `d_i = c d_(i-1) + w_i` stationary, `var v = share var w`. The bidiagonal
D with the first row `sqrt(1 - c^2)` makes the drift white; `cov(D x) = var w (I + share D D^T)` is tridiagonal, and its
Cholesky factor makes white what D left: O(n) for any c and share. Both are chosen by restricted maximum likelihood
(H. D. Patterson, R. Thompson, Biometrika 58(3), 1971), as a fit of k numbers takes a part of the drift out of the
residuals.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky_banded, solve_banded

_CORRELATIONS = (0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.999)
_SHARES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)


@dataclass(frozen=True)
class DriftNoise:
    """sigma: standard deviation of w, in the unit of the errors. correlation: c in [0, 1). share: `var v / var w`.

    White noise has `correlation` and `share` zero.
    """

    sigma: float
    correlation: float = 0.0
    share: float = 0.0

    def whitened(self, rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Rows of unit variance and without correlation, from those of errors or their derivatives."""
        return self._factored(rows)[0]

    def _factored(self, rows: np.ndarray) -> tuple[np.ndarray, float]:
        """`whitened`, and the logarithm of the determinant of the covariance without `sigma`."""
        c, first = self.correlation, np.sqrt(1.0 - self.correlation**2)
        white = np.concatenate([first * rows[:1], rows[1:] - c * rows[:-1]])
        band = np.zeros((2, len(rows)))
        band[0] = 1.0 + self.share * (1.0 + c * c)
        band[0, 0] = 1.0 + self.share * first**2
        band[1, :-1] = -self.share * c
        band[1, :1] *= first
        lower = cholesky_banded(band, lower=True)
        determinant = 2.0 * float(np.log(lower[0]).sum()) - 2.0 * float(np.log(first))
        return solve_banded((1, 0), lower, white) / self.sigma, determinant

    @classmethod
    def of(cls, errors: Float[np.ndarray, "n 3"], jacobian: Float[np.ndarray, "n 3 k"], least: float) -> "DriftNoise":
        """The likeliest for residuals of a fit with that `jacobian`; deviations below `least` are rounding."""
        count, unknowns = len(errors), jacobian.shape[2]
        kinds = [cls(1.0), *(cls(1.0, c, share) for c in _CORRELATIONS for share in _SHARES)]
        rows = np.concatenate([errors, jacobian.reshape(count, -1)], axis=1)
        degrees = max(3 * count - unknowns, 1)
        best = np.inf, kinds[0]
        for kind in kinds:
            white, determinant = kind._factored(rows)
            variance = max(float((white[:, :3] ** 2).sum()) / degrees, least**2)
            matrix = white[:, 3:].reshape(3 * count, unknowns)
            lost = np.linalg.slogdet(matrix.T @ matrix + 1e-12 * np.eye(unknowns))[1]
            cost = degrees * np.log(variance) + 3.0 * determinant + lost
            best = min(best, (cost, cls(np.sqrt(variance), kind.correlation, kind.share)), key=lambda one: one[0])
        return best[1]
