"""The solver's normal equations against automatic differentiation of residuals written by hand."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from jax.flatten_util import ravel_pytree
from scenes import make_scene, matrix
from scipy.linalg import expm
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, dense_schur_complement, multiply
from vggtgeo.solvers.reduced import DenseCholesky

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.problem import Problem, State

SCENE = make_scene(noise=0.7, outliers=0.2, depth_error=0.1, seed=1)


@dataclass(frozen=True)
class Linearised:
    """The system of the solver beside `J' J` and `J' r` of the same residuals in the same coordinates."""

    system: ArrowSystem
    matrix: np.ndarray
    """Of the system, dense: poses, intrinsics, inverse depths."""
    gradient: np.ndarray
    jacobian: np.ndarray
    residual: np.ndarray


def one_behind_its_target(state: State) -> State:
    """The state with one landmark so near that it lies behind every other camera."""
    return State(state.poses, state.intrinsics, state.inverse_depth.at[0, 0].set(60.0))


@jax.jit
def linearise_both(problem: Problem, state: State):
    ba = BundleAdjustment(problem)
    system, zero = ba.linearise(state), ba.zero_step(state)
    flat, unflat = ravel_pytree(zero)
    weights = oracle.reweighted(problem, state)
    vector = lambda step: oracle.weighted_residuals(problem, ba.retract(state, unflat(step)), weights)
    matrix = jax.vmap(lambda column: ravel_pytree(multiply(system, unflat(column)))[0])(jnp.eye(len(flat))).T
    gradient = jnp.concatenate([dense_schur_complement(system).gradient, system.landmark_gradient.ravel()])
    return system, matrix, gradient, jax.jacfwd(vector)(flat), vector(flat)


@pytest.fixture(scope="module")
def linearised() -> Linearised:
    problem, state, _ = SCENE.pack()
    return Linearised(*linearise_both(problem, one_behind_its_target(state)))


def test_gradient_and_hessian_are_those_of_the_columns(linearised: Linearised) -> None:
    # Proves every derivative column, the edge factoring and the assembly at once, outliers and a point behind a camera
    # included. Oracle: J' J and J' r with J from forward-mode differentiation of the residuals.
    hessian, gradient = linearised.jacobian.T @ linearised.jacobian, linearised.jacobian.T @ linearised.residual
    # Each unknown in units of its own curvature: pixels, metres and 1/m side by side.
    unit = 1 / np.sqrt(np.diag(hessian))
    error = np.abs((linearised.matrix - hessian) * np.outer(unit, unit)).max()
    assert error < 1e-10
    error = np.abs((linearised.gradient - gradient) * unit).max() / np.abs(gradient * unit).max()
    assert error < 1e-10


def test_the_bound_on_depth_is_met() -> None:
    # Proves that the case behind a camera is in the test above. Oracle: the depth of that point, by hand.
    problem, state, _ = SCENE.pack()
    z = oracle.seen_from(problem, one_behind_its_target(state))[:, 0, 2]
    seen = (problem.edges.source == 0) & (problem.points.weight[:, 0] > 0)
    assert float(jnp.min(jnp.where(seen, z, jnp.inf))) < oracle.LEAST_DEPTH


def test_one_step_is_the_dense_step(linearised: Linearised) -> None:
    # Proves one Levenberg-Marquardt step of bundle adjustment. Oracle: a dense solve of the damped normal equations
    # made of the automatic Jacobian, the first pose held.
    damping, solver = 1e-3, DenseCholesky()
    step, _ = jax.jit(lambda system: solver.step(system, solver.prepare(system), jnp.asarray(damping)))(
        linearised.system
    )
    hessian, gradient = linearised.jacobian.T @ linearised.jacobian, linearised.jacobian.T @ linearised.residual
    matrix = (hessian + damping * np.diag(np.diag(hessian)))[6:, 6:]
    expected = np.concatenate([np.zeros(6), np.linalg.solve(matrix, -gradient[6:])])
    found = np.concatenate([step.dense, np.ravel(step.landmarks)])
    unit = np.sqrt(np.diag(hessian))
    error = np.abs((found - expected) * unit).max() / np.abs(expected * unit).max()
    assert error < 1e-8


def test_retract_moves_poses_by_left_tangents() -> None:
    # Proves `T <- exp(x) T`, and that inverse depths stop at their bound. Oracle: the exponential of 4 x 4 matrices.
    problem, state, _ = SCENE.pack()
    ba, rng = BundleAdjustment(problem), np.random.default_rng(0)
    zero = ba.zero_step(state)
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
