"""Robust kernels: values, derivatives, and what they do to outliers."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vggtgeo.solvers.kernels import AbstractKernel, Barron, Cauchy, GemanMcClure, Huber, Square

KERNELS = {
    "square": Square(),
    "huber": Huber(1.5),
    "cauchy": Cauchy(0.8),
    "geman-mcclure": GemanMcClure(1.2),
    "barron 1": Barron(1.5, 1.0),
    "barron -1.5": Barron(0.7, -1.5),
}
SQUARES = jnp.array([0.0, 1e-9, 0.01, 0.6, 1.0, 2.24, 2.26, 10.0, 1e4])  # either side of Huber's 1.5^2
ROBUST = [name for name in KERNELS if name != "square"]


def _relative(value: jax.Array, oracle: jax.Array) -> float:
    return float(np.max(np.abs(value - oracle) / (np.abs(oracle) + 1e-12)))


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_weight_and_curvature_are_the_derivatives(kernel: AbstractKernel) -> None:
    # Proves that `weight` is rho' and `curvature` rho'', and that small residuals are least squares: rho(0) = 0 and
    # rho'(0) = 1. Oracle: automatic differentiation of `rho`.
    first = jax.vmap(jax.grad(kernel.rho))(SQUARES)
    second = jax.vmap(jax.grad(jax.grad(kernel.rho)))(SQUARES)
    assert _relative(kernel.weight(SQUARES), first) < 1e-12
    assert _relative(kernel.curvature(SQUARES), second) < 1e-9
    assert float(kernel.rho(SQUARES)[0]) == 0.0
    assert float(kernel.weight(SQUARES)[0]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("name", ROBUST)
def test_outliers_pull_less(name: str) -> None:
    # Proves that a robust kernel never exceeds the square and that its weight falls towards zero without turning.
    kernel = KERNELS[name]
    squares = jnp.linspace(0.0, 400.0, 200)
    weights = kernel.weight(squares)
    assert bool(jnp.all(kernel.rho(squares) <= squares + 1e-12))
    assert bool(jnp.all(jnp.diff(weights) <= 1e-15))
    assert 0 < float(weights[-1]) < 0.1
    assert bool(jnp.all(kernel.curvature(squares) <= 0))


def test_huber_by_hand() -> None:
    # Proves Huber's two branches and that they meet. Oracle: |r| = 1 and 3 with delta 1.5, worked by hand.
    kernel = Huber(1.5)
    np.testing.assert_allclose(kernel.rho(jnp.array([1.0, 9.0])), [1.0, 2 * 1.5 * 3 - 2.25], rtol=1e-15)
    below, above = kernel.rho(jnp.array([2.25 - 1e-9, 2.25 + 1e-9]))
    assert float(above - below) == pytest.approx(2e-9, rel=1e-3)


def test_barron_contains_geman_mcclure() -> None:
    # Proves the shape parameter of the general kernel: alpha = -2 is Geman-McClure with delta scaled by 2 (b = 4).
    general, special = Barron(1.1, -2.0), GemanMcClure(2.2)
    assert _relative(general.rho(SQUARES), special.rho(SQUARES)) < 1e-9


@pytest.mark.parametrize(("make", "named"), [(lambda: Huber(-1.0), "delta"), (lambda: Barron(alpha=2.0), "alpha")])
def test_invalid_parameters(make: Callable[[], AbstractKernel], named: str) -> None:
    # Proves that a kernel without a positive width, or of a shape without a kernel, cannot be made.
    with pytest.raises(ValueError, match=named):
        make()
