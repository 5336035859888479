"""Noise model of trajectory errors: white noise plus a first-order autoregressive drift, and its whitening.

The error of pose i is `d_i + v_i` with the stationary drift `d_i = c d_(i-1) + w_i` and `var v = share var w`. The
bidiagonal D with the first row `sqrt(1 - c^2)` whitens the drift; `cov(D x) = var w (I + share D D^T)` is tridiagonal,
and its Cholesky factor whitens the rest: O(n) for any c and share. Both are estimated by restricted maximum likelihood
(H. D. Patterson, R. Thompson, Biometrika 58(3), 1971), since a fit of k parameters removes a part of the drift from the
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
        """Return `rows` of errors or their derivatives, whitened: unit variance, no correlation."""
        return self._factored(rows)[0]

    def _factored(self, rows: np.ndarray) -> tuple[np.ndarray, float]:
        """Return whitened rows, and the log determinant of the covariance for `sigma` 1."""
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
    def of(
        cls, errors: Float[np.ndarray, "n 3"], jacobian: Float[np.ndarray, "n 3 k"], min_sigma: float
    ) -> "DriftNoise":
        """Return the most likely noise for the residuals of a fit with this `jacobian`; `min_sigma`: rounding error."""
        count, unknowns = len(errors), jacobian.shape[2]
        kinds = [cls(1.0), *(cls(1.0, c, share) for c in _CORRELATIONS for share in _SHARES)]
        rows = np.concatenate([errors, jacobian.reshape(count, -1)], axis=1)
        degrees = max(3 * count - unknowns, 1)
        best = np.inf, kinds[0]
        for kind in kinds:
            white, determinant = kind._factored(rows)
            variance = max(float((white[:, :3] ** 2).sum()) / degrees, min_sigma**2)
            matrix = white[:, 3:].reshape(3 * count, unknowns)
            # The restricted likelihood's term for the fitted parameters.
            information = np.linalg.slogdet(matrix.T @ matrix + 1e-12 * np.eye(unknowns))[1]
            cost = degrees * np.log(variance) + 3.0 * determinant + information
            best = min(best, (cost, cls(np.sqrt(variance), kind.correlation, kind.share)), key=lambda one: one[0])
        return best[1]
