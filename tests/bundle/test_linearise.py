"""The solver's normal equations and exact Hessian against automatic differentiation of residuals written by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from arrow_systems import check_exact_hessian, dense_matrix, zero_step
from jax.flatten_util import ravel_pytree
from priors import prior_on
from scenes import make_scene, matrix
from scipy.linalg import expm
from vggtgeo.solvers.arrow import ArrowVector
from vggtgeo.solvers.schur_complement import dense_schur_complement

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.problem import Problem, State

SCENE = make_scene(noise=0.7, outliers=0.2, depth_error=0.1, seed=1)


@jax.jit
def linearise_both(problem: Problem, state: State):
    ba = BundleAdjustment(problem)
    system, zero = ba.linearise(state), zero_step(ba, state)
    flat, unflat = ravel_pytree(zero)
    weights = oracle.reweighted(problem, state)
    vector = lambda step: oracle.weighted_residuals(problem, ba.retract(state, unflat(step)), weights)
    matrix = dense_matrix(system, zero)
    gradient = jnp.concatenate([dense_schur_complement(system).gradient, system.landmark_gradient.ravel()])
    return matrix, gradient, jax.jacfwd(vector)(flat), vector(flat)


def test_gradient_and_hessian_are_those_of_the_columns() -> None:
    # Proves every derivative column, the edge factoring and the assembly at once, outliers and a point behind a camera
    # included. Oracle: J' J and J' r with J from forward-mode differentiation of the residuals.
    problem, state, _ = SCENE.pack()
    state = State(state.poses, state.intrinsics, state.inverse_depth.at[0, 0].set(60.0))  # behind other cameras
    seen = (problem.edges.source == 0) & (problem.terms["points"].weight[:, 0] > 0)
    assert float(jnp.min(oracle.seen_from(problem, state)[:, 0, 2], where=seen, initial=jnp.inf)) < oracle.LEAST_DEPTH
    matrix, found, jacobian, residual = linearise_both(problem, state)
    hessian, gradient = np.asarray(jacobian.T @ jacobian), jacobian.T @ residual
    # Each unknown in units of its own curvature: pixels, metres and 1/m side by side.
    unit = 1 / np.sqrt(np.diag(hessian))
    error = np.abs((matrix - hessian) * np.outer(unit, unit)).max()
    assert error < 1e-10
    error = np.abs((found - gradient) * unit).max() / np.abs(gradient * unit).max()
    assert error < 1e-10


def test_retract_moves_poses_by_left_tangents() -> None:
    # Proves `T <- exp(x) T`, and that inverse depths stop at their bound. Oracle: the exponential of 4 x 4 matrices.
    problem, state, _ = SCENE.pack()
    ba, rng = BundleAdjustment(problem), np.random.default_rng(0)
    zero = zero_step(ba, state)
    dense = rng.normal(0, 0.3, zero.dense.shape)
    landmarks = jnp.full_like(zero.landmarks, -100.0).at[0, 0].set(0.25)
    moved = ba.retract(state, ArrowVector(jnp.asarray(dense), landmarks))
    before, after = (as_matrices(poses.poses.wxyz_xyz) for poses in (state, moved))
    for pose, found, (v, w) in zip(before, after, dense[:-4].reshape(-1, 2, 3), strict=True):
        twist = np.zeros((4, 4))
        twist[:3] = np.column_stack([np.cross(w, np.eye(3)).T, v])
        np.testing.assert_allclose(found, expm(twist) @ pose, atol=1e-12)
    np.testing.assert_allclose(moved.intrinsics - state.intrinsics, dense[-4:], atol=1e-12)
    assert float(moved.inverse_depth[0, 0]) == float(state.inverse_depth[0, 0]) + 0.25
    np.testing.assert_allclose(np.ravel(moved.inverse_depth)[1:], 1e-6, rtol=1e-12)


def as_matrices(poses: jax.Array) -> np.ndarray:
    """World -> camera as `[n, 4, 4]`."""
    rotations, translations = matrix(np.asarray(poses))
    whole = np.tile(np.eye(4), (len(poses), 1, 1))
    whole[:, :3, :3], whole[:, :3, 3] = rotations, translations
    return whole


BENT = make_scene(2, 4, 1, 2, noise=0.7, outliers=0.3, depth_error=0.2, seed=3)


@pytest.mark.long
@pytest.mark.parametrize("strength", [0.0, 3.0], ids=["no prior", "marginal prior"])
@pytest.mark.parametrize("depth", [None, 60.0], ids=["in front", "behind"])
def test_hessian_is_that_of_automatic_differentiation(strength: float, depth: float | None) -> None:
    # Proves the exact Hessian: points, lines, outliers on Huber's linear branch, curvature of the poses, intrinsics,
    # the marginalisation prior, and a point behind its target. Oracle: `jax.hessian` of the energy after a retraction.
    problem, state, _ = BENT.pack()
    offset = (state.inverse_depth - problem.terms["depth"].mean) / problem.terms["depth"].sigma
    squared = problem.terms["depth"].alpha * problem.terms["depth"].weight * offset**2
    assert 0 < int(jnp.sum(squared > 1.5**2)) < squared.size  # on both branches of Huber's kernel
    problem = problem.with_term(prior_on(state, strength))
    if depth is not None:
        state = eqx.tree_at(lambda s: s.inverse_depth, state, state.inverse_depth.at[0, 0].set(depth))
    check_exact_hessian(problem, state, oracle.energy)
