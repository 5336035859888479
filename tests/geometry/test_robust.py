"""Constants of robust estimation, and inverses of information matrices."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, norm

from vggtgeo.geometry.robust import MAD_SIGMA, POSE_GATE, REGULARISER, TUKEY, inverse_information, two_way_clustered


def test_tukey_is_95_percent_efficient() -> None:
    # Proves the cut of the biweight. Oracle: the asymptotic variance of the M-estimator, `E[psi^2] / E[psi']^2`, by
    # integration over the normal distribution.
    psi = lambda x: x * (1 - (x / TUKEY) ** 2) ** 2
    slope = lambda x: (1 - (x / TUKEY) ** 2) * (1 - 5 * (x / TUKEY) ** 2)
    mean = lambda f: quad(lambda x: f(x) * norm.pdf(x), -TUKEY, TUKEY)[0]
    assert mean(slope) ** 2 / mean(lambda x: psi(x) ** 2) == pytest.approx(0.95, abs=1e-4)


def test_constants_are_quantiles() -> None:
    # Proves both constants. Oracle: quantiles of the normal and the chi-square distribution.
    assert pytest.approx(1 / norm.ppf(0.75), abs=1e-4) == MAD_SIGMA
    assert chi2.sf(POSE_GATE, 6) == pytest.approx(1e-4)


def test_information_without_a_direction_has_a_covariance() -> None:
    # Proves the inverse of a singular matrix: right along known directions, to the digits that a condition of 1e13
    # leaves, and very large along the others. Oracle: the eigenvalues that the matrix was made of.
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    sizes = np.array([1e4, 1e2, 1.0, 1e3, 10.0, 0.0])
    found = basis.T @ inverse_information(np.tile((basis * sizes) @ basis.T, (2, 1, 1))) @ basis
    np.testing.assert_allclose(found[:, range(5), range(5)], np.tile(1 / sizes[:5], (2, 1)), rtol=1e-3)
    np.testing.assert_allclose(found[:, 5, 5], 1 / REGULARISER, rtol=1e-2)


def test_errors_that_clusters_share_are_counted() -> None:
    """A sum whose terms share an error by row and by column has the covariance of simulation. Oracle: 4,000 draws."""
    rng = np.random.default_rng(2)
    side, draws = 40, 4000
    first, second = np.divmod(np.arange(side * side), side)

    def scores() -> np.ndarray:
        return (rng.normal(size=side)[first] + 0.5 * rng.normal(size=side)[second] + rng.normal(size=side**2))[:, None]

    expected = np.var([scores().sum() for _ in range(draws)])
    found = np.mean([two_way_clustered(scores(), first, second)[0, 0] for _ in range(200)])
    assert found == pytest.approx(expected, rel=0.1)
    independent = np.mean([(scores() ** 2).sum() for _ in range(20)])
    assert expected > 20 * independent
