"""The exact Hessian of bundle adjustment against automatic differentiation of an energy written by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from jax.flatten_util import ravel_pytree
from priors import prior_on
from scenes import make_scene
from vggtgeo.solvers.arrow import dense_schur_complement, multiply

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.problem import Problem, State

SCENE = make_scene(2, 4, 1, 2, noise=0.7, outliers=0.3, depth_error=0.2, seed=3)


@jax.jit
def both(problem: Problem, state: State) -> tuple[jax.Array, ...]:
    """Gradient and Hessian, dense, of the solver's arrow and of the energy in the same coordinates."""
    ba = BundleAdjustment(problem)
    flat, unflat = ravel_pytree(ba.zero_step(state))
    total = lambda step: oracle.energy(problem, ba.retract(state, unflat(step)))
    system = ba.hessian(state)
    matrix = jax.vmap(lambda column: ravel_pytree(multiply(system, unflat(column)))[0])(jnp.eye(len(flat))).T
    gradient = jnp.concatenate([dense_schur_complement(system).gradient, system.landmark_gradient.ravel()])
    return gradient, matrix, jax.grad(total)(flat), jax.hessian(total)(flat)


@pytest.mark.long
@pytest.mark.parametrize("strength", [0.0, 3.0], ids=["no prior", "marginal prior"])
@pytest.mark.parametrize("depth", [None, 60.0], ids=["in front", "behind"])
def test_hessian_is_that_of_automatic_differentiation(strength: float, depth: float | None) -> None:
    # Proves the exact Hessian: points, lines, outliers on Huber's linear branch, curvature of the poses, intrinsics,
    # the marginalisation prior, and a point behind its target. Oracle: `jax.hessian` of the energy after a retraction.
    problem, state, _ = SCENE.pack()
    problem = problem.with_term(prior_on(state, strength))
    if depth is not None:
        state = eqx.tree_at(lambda s: s.inverse_depth, state, state.inverse_depth.at[0, 0].set(depth))
    gradient, matrix, expected_gradient, expected = both(problem, state)
    unit = 1 / np.sqrt(np.abs(np.diag(expected)) + 1.0)
    error = np.abs((matrix - expected) * np.outer(unit, unit)).max()
    assert error < 1e-9
    error = np.abs((gradient - expected_gradient) * unit).max() / np.abs(expected_gradient * unit).max()
    assert error < 1e-11


def test_the_scene_bends_every_branch() -> None:
    # Proves that the problem above has depths on both of Huber's branches. Oracle: squared residuals against delta^2.
    problem, state, _ = SCENE.pack()
    offset = (state.inverse_depth - problem.depth.mean) / problem.depth.sigma
    squared = problem.depth.alpha * problem.depth.weight * offset**2
    assert 0 < int(jnp.sum(squared > 1.5**2)) < squared.size
