"""Which of optimistix's adjoints `solve` takes: what works does so by itself, what cannot is refused."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optimistix as optx
import pytest

import vggtgeo as vg

SOLVER = vg.SchurLevenbergMarquardt(rtol=0.0, atol=0.0, max_iterations=12)


@pytest.fixture(scope="module")
def loss() -> Callable[..., jax.Array]:
    """Distance of a solution from the origin, of a small problem with its points weighted."""
    problem, initial, _ = vg.simulate_window(2, points=8, lines=0, host_noise=False).pack(kernel=vg.kernels.Square())

    def value(share: jax.Array, **options: optx.AbstractAdjoint) -> jax.Array:
        points = problem.points.reweighted(share * problem.points.weight)
        state = vg.solve(problem.with_term(points), initial, solver=SOLVER, **options).state
        return jnp.sum(state.poses.inverse().translation() ** 2)

    return value


def test_the_adjoint_through_the_iterates_can_be_traced_alone(loss: Callable[..., jax.Array]) -> None:
    """Reverse mode through `RecursiveCheckpointAdjoint()` alone raises nothing, with an explicit solver, too. Oracle:
    JAX's own trace, which refuses a loop without bounds.
    """
    through = jax.grad(lambda share: loss(share, adjoint=optx.RecursiveCheckpointAdjoint()))
    assert jax.eval_shape(through, jnp.ones(())).shape == ()


@pytest.mark.long
def test_the_adjoint_through_the_iterates_needs_no_option_of_the_solver(loss: Callable[..., jax.Array]) -> None:
    """`RecursiveCheckpointAdjoint()` alone differentiates the iterates. Oracle: the implicit derivative, which is that
    of the limit of the iterates.
    """
    through = jax.jit(jax.grad(lambda share: loss(share, adjoint=optx.RecursiveCheckpointAdjoint())))(jnp.ones(()))
    implicit = jax.jit(jax.grad(loss))(jnp.ones(()))
    assert abs(float(implicit)) > 1e-6
    assert float(through) == pytest.approx(float(implicit), rel=1e-5)
