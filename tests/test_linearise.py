"""The solver's hand-written derivatives against automatic differentiation of the readable residuals."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scenes import make_scene
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, multiply, reduce
from vggtgeo.solvers.reduced import DenseCholesky

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.objective import relative_poses
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residuals import MIN_RELATIVE_DEPTH, depth_residual, line_residual, point_residual
from vggtgeo.geometry import lie

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


def weighted_residuals(problem: Problem, state: State, weights: list[jax.Array]) -> jax.Array:
    """All residuals as one vector, each times the root of a given weight."""
    relative, host, p = relative_poses(problem, state), problem.edges.source, problem.num_points
    pixels, depths = problem.pixels[host], state.inverse_depth[host]
    over = lambda function: jax.vmap(jax.vmap(function, (None, None, 0, 0, 0)), (0, None, 0, 0, 0))
    points = over(point_residual)(relative, state.intrinsics, pixels[:, :p], depths[:, :p], problem.points.target)
    lines = over(line_residual)(relative, state.intrinsics, pixels[:, p:], depths[:, p:], problem.lines.coefficients)
    prior = problem.depth
    depth = jax.vmap(jax.vmap(depth_residual))(state.inverse_depth, prior.mean, prior.sigma)
    shared = state.intrinsics - problem.intrinsics_prior.mean
    parts = [points * jnp.sqrt(weights[0])[..., None]]
    parts += [r * jnp.sqrt(w) for r, w in zip((lines, depth, shared), weights[1:], strict=True)]
    return jnp.concatenate([part.ravel() for part in parts])


def reweighted(problem: Problem, state: State) -> list[jax.Array]:
    """`w rho'(w |r|^2)` of every residual: the weights of one iteration of reweighted least squares."""
    plain = [problem.points.weight, problem.lines.weight, problem.depth.alpha * problem.depth.weight]
    ones = [*(jnp.ones_like(weight) for weight in plain), jnp.ones(4)]
    residual = weighted_residuals(problem, state, ones)
    sizes = [2 * plain[0].size, plain[1].size, plain[2].size]
    points, lines, depth, _ = jnp.split(residual, np.cumsum(sizes))
    squared = [jnp.sum(points.reshape(*plain[0].shape, 2) ** 2, -1), lines.reshape(plain[1].shape) ** 2]
    squared.append(depth.reshape(plain[2].shape) ** 2)
    weights = [w * problem.kernel.weight(w * s) for w, s in zip(plain, squared, strict=True)]
    return [*weights, problem.intrinsics_prior.information]


def one_behind_its_target(state: State) -> State:
    """The state with one landmark so near that it lies behind every other camera."""
    return State(state.poses, state.intrinsics, state.inverse_depth.at[0, 0].set(60.0))


@jax.jit
def linearise_both(problem: Problem, state: State):
    ba = BundleAdjustment(problem)
    system, zero = ba.linearise(state), ba.zero_step(state)
    flat, unflat = ravel_pytree(zero)
    weights = reweighted(problem, state)
    vector = lambda step: weighted_residuals(problem, ba.retract(state, unflat(step)), weights)
    matrix = jax.vmap(lambda column: ravel_pytree(multiply(system, unflat(column)))[0])(jnp.eye(len(flat))).T
    gradient = jnp.concatenate([reduce(system).gradient, system.landmark_gradient.ravel()])
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


def test_the_bound_on_depth_is_met(linearised: Linearised) -> None:
    # Proves that the case behind a camera is in the test above. Oracle: the depth of that point, in numpy.
    problem, state, _ = SCENE.pack()
    state = one_behind_its_target(state)
    relative = relative_poses(problem, state)
    fx, fy, cx, cy = state.intrinsics
    ray = jnp.array([(problem.pixels[0, 0, 0] - cx) / fx, (problem.pixels[0, 0, 1] - cy) / fy, 1.0])
    z = (relative.rotation().as_matrix() @ ray + 60.0 * relative.translation())[:, 2]
    seen = (problem.edges.source == 0) & (problem.points.weight[:, 0] > 0)
    assert float(jnp.min(jnp.where(seen, z, jnp.inf))) < MIN_RELATIVE_DEPTH


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
    # Proves `T <- exp(x) T` and the positive depth. Oracle: the matrix exponential's inverse, `boxminus`.
    problem, state, _ = SCENE.pack()
    ba, rng = BundleAdjustment(problem), np.random.default_rng(0)
    zero = ba.zero_step(state)
    dense = jnp.asarray(rng.normal(0, 0.3, zero.dense.shape))
    moved = ba.retract(state, ArrowVector(dense, jnp.full_like(zero.landmarks, -100.0)))
    tangents = lie.boxminus(moved.poses, state.poses)
    np.testing.assert_allclose(tangents.ravel(), dense[:-4], atol=1e-12)
    np.testing.assert_allclose(moved.intrinsics - state.intrinsics, dense[-4:], atol=1e-12)
    assert bool(jnp.all(moved.inverse_depth > 0))
