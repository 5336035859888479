"""Two-ends lines: the inverse depths of a segment's samples lie on a straight line, two unknowns a segment."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arrow_systems import dense_matrix, zero_step
from jax.flatten_util import ravel_pytree
from scenes import Scene, make_scene
from vggtgeo.solvers.arrow import ArrowVector
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced_solvers import DenseCholesky

from vggtgeo.bundle.analysis.covariances import covariances
from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.objective import energy
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import solve
from vggtgeo.geometry.line_segments import fractions, segment_slots, straightened

POINTS, SEGMENTS, SAMPLES = 6, 2, 4
SOLVER = SchurLevenbergMarquardt(rtol=1e-12, max_iterations=100)


@cache
def scene(noise: float = 0.5) -> Scene:
    """Segments of four samples, numbered."""
    made = make_scene(3, points=POINTS, lines=SEGMENTS, samples=SAMPLES, noise=noise, depth_error=0.05, seed=5)
    return made.with_segments(SAMPLES)


def affine(problem: Problem) -> np.ndarray:
    """`B`, from the two ends of every segment (and the points) to all slots, as a dense matrix."""
    fraction = np.asarray(problem.fraction)
    hosts, segments, samples = fraction.shape
    points = problem.terms["lines"].first_slot
    matrix = np.zeros((hosts, points + segments * samples, points + 2 * segments))
    matrix[:, np.arange(points), np.arange(points)] = 1
    for segment in range(segments):
        rows = points + segment * samples + np.arange(samples)
        matrix[:, rows, points + segment] = 1 - fraction[:, segment]
        matrix[:, rows, points + segments + segment] = fraction[:, segment]
    whole = np.zeros((hosts * matrix.shape[1], hosts * matrix.shape[2]))
    for host in range(hosts):
        rows = slice(host * matrix.shape[1], (host + 1) * matrix.shape[1])
        whole[rows, host * matrix.shape[2] : (host + 1) * matrix.shape[2]] = matrix[host]
    return whole


@eqx.filter_jit
def sampled_matrix(problem: Problem, state: State) -> tuple[jax.Array, jax.Array]:
    """Matrix and gradient of the same problem with a depth for each sample."""
    ba = BundleAdjustment(replace(problem, fraction=None))
    matrix = dense_matrix(ba.linearise(state), zero_step(ba, state))
    return matrix, ravel_pytree(ba.gradient(state))[0]


def reduced_to_ends(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Free part of `B' H B` and `B' g`, and the basis `B` over all unknowns."""
    matrix, gradient = map(np.asarray, sampled_matrix(problem, state))
    dense = problem.num_camera
    basis = affine(problem)
    whole = np.zeros((dense + basis.shape[0], dense + basis.shape[1]))
    whole[:dense, :dense] = np.eye(dense)
    whole[dense:, dense:] = basis
    return (whole.T @ matrix @ whole)[6:, 6:], (whole.T @ gradient)[6:], whole[:, 6:]


@eqx.filter_jit
def newton(problem: Problem, state: State) -> ArrowVector:
    system, solver = BundleAdjustment(problem).linearise(state), DenseCholesky()
    step, _ = solver.step(system, solver.prepare(system), jnp.asarray(0.0))
    return ArrowVector(step.dense, system.basis.expand(step.landmarks))


def test_the_step_is_the_constrained_dense_step() -> None:
    # Proves joining, elimination and expansion. Oracle: a dense solve of `B' H B`, with `H` of the sampled problem.
    problem, state, _ = scene().pack()
    matrix, gradient, basis = reduced_to_ends(problem, state)
    expected = basis @ np.linalg.solve(matrix, -gradient)
    step = newton(problem, state)
    found = np.concatenate([step.dense, np.ravel(step.landmarks)])
    unit = np.sqrt(np.diag(np.asarray(sampled_matrix(problem, state)[0])))
    assert np.abs((found - expected) * unit).max() < 1e-7 * np.abs(expected * unit).max()


@eqx.filter_jit
def run(problem: Problem, state: State):
    return solve(problem, state, solver=SOLVER)


def test_the_optimum_is_straight_and_stationary() -> None:
    # Proves `solve` with two-ends lines. Oracles: second differences along each segment, and the gradient `B' g` of the
    # readable energy by automatic differentiation.
    problem, state, _ = scene().pack()
    found = run(problem, state)
    assert found.converged
    lines = np.asarray(found.state.inverse_depth)[:, POINTS:].reshape(3, SEGMENTS, SAMPLES)
    fraction = np.asarray(problem.fraction)
    ends = lines[..., :1] + fraction * (lines[..., -1:] - lines[..., :1])
    np.testing.assert_allclose(lines, ends, rtol=1e-10)
    gradient = jax.grad(lambda depth: energy(problem, replace(found.state, inverse_depth=depth)))
    pulled = affine(problem).T @ np.ravel(gradient(found.state.inverse_depth))
    assert np.abs(pulled).max() < 1e-4
    free = run(replace(problem, fraction=None), state)
    assert float(found.energy) > float(free.energy)


def test_without_noise_both_find_the_truth() -> None:
    # Proves that the constraint is right: inverse depth is straight along the image of a line. Oracle: the truth.
    made = make_scene(3, points=POINTS, lines=SEGMENTS, samples=SAMPLES, seed=5)
    made = made.with_segments(SAMPLES)
    problem, state, index = made.pack(prior_sigma=None)
    found = run(problem, state)
    np.testing.assert_allclose(index.gather(found.state.inverse_depth), made.inverse_depth, rtol=1e-5)


def test_the_covariance_is_that_of_the_dense_inverse() -> None:
    # Proves variances of samples whose segment is two unknowns. Oracle: `B (B' H B)^-1 B'`, dense.
    problem, state, _ = scene().pack()
    solved = run(problem, state).state
    matrix, _, basis = reduced_to_ends(problem, solved)
    expected = np.diag(basis @ np.linalg.inv(matrix) @ basis.T)
    found = eqx.filter_jit(covariances)(problem, solved)
    np.testing.assert_allclose(np.ravel(found.inverse_depth), expected[problem.num_camera :], rtol=1e-6)
    np.testing.assert_allclose(np.diag(found.poses[1]), expected[6:12], rtol=1e-6)


@pytest.mark.long
def test_gradients_are_those_of_central_differences() -> None:
    # Proves implicit differentiation through the constrained optimum. Oracle: central differences of whole solves.
    problem, state, _ = scene().pack()
    rng = np.random.default_rng(1)
    target = jnp.asarray(rng.normal(size=state.inverse_depth.shape))

    def loss(leaves: tuple[jax.Array, ...]) -> jax.Array:
        changed = eqx.tree_at(lambda p: (p.terms["lines"].weight, p.terms["depth"].mean, p.fraction), problem, leaves)
        solved = solve(changed, state, solver=SOLVER).state
        return jnp.sum(solved.inverse_depth * target) + jnp.sum(solved.poses.wxyz_xyz**3)

    both = jax.jit(jax.value_and_grad(loss))  # its value is that of the polished optimum
    at = (problem.terms["lines"].weight, problem.terms["depth"].mean, problem.fraction)
    value, (_, found) = lambda leaves: both(leaves)[0], both(at)
    for number in range(3):
        direction = jnp.asarray(rng.normal(size=at[number].shape)) * (at[number] > 0)
        shifted = lambda h, n=number, d=direction: tuple(x + h * d if i == n else x for i, x in enumerate(at))
        expected = (value(shifted(1e-5)) - value(shifted(-1e-5))) / 2e-5
        assert float(jnp.sum(found[number] * direction)) == pytest.approx(float(expected), rel=1e-5)


def test_a_step_beyond_infinity_is_shortened_as_a_whole() -> None:
    # Proves that the bound on depth keeps segments straight and positive. Oracle: second differences.
    problem, state, _ = scene().pack()
    ba = BundleAdjustment(problem)
    steps = np.zeros(state.inverse_depth.shape)
    steps[:, POINTS:] = -10.0 * np.asarray(problem.fraction).reshape(3, -1)
    moved = ba.retract(state, ArrowVector(zero_step(ba, state).dense, jnp.asarray(steps)))
    lines = np.asarray(moved.inverse_depth)[:, POINTS:].reshape(3, SEGMENTS, SAMPLES)
    assert np.all(lines > 0)
    ends = lines[..., :1] + np.asarray(problem.fraction) * (lines[..., -1:] - lines[..., :1])
    np.testing.assert_allclose(lines, ends, rtol=1e-10)


def test_segments_of_unequal_length_are_packed() -> None:
    # Proves slots, fractions and straight starts with padding, in a larger size too. Oracles: numbers by hand, polyfit.
    host, number = np.array([0, 0, 0, 1, 1, 0, 0]), np.array([7, 7, 7, 3, 3, 9, 9])
    rank, position = segment_slots(host, number)
    assert rank.tolist() == [0, 0, 0, 0, 0, 1, 1]
    assert position.tolist() == [0, 1, 2, 0, 1, 0, 1]
    pixels = np.array([[[[0, 0], [3, 4], [6, 8]], [[1, 1], [1, 3], [0, 0]]]], float)
    present = np.array([[[True, True, True], [True, True, False]]])
    share = fractions(pixels, present)
    np.testing.assert_allclose(share[0], [[0, 0.5, 1], [0, 1, 0]])
    depths = np.array([[[1.0, 1.4, 1.5], [2.0, 3.0, 9.0]]])
    straight = straightened(depths, share, present)
    np.testing.assert_allclose(straight[0, 0], np.polyval(np.polyfit(share[0, 0], depths[0, 0], 1), share[0, 0]))
    np.testing.assert_allclose(straight[0, 1, :2], [2.0, 3.0])
    problem, state, _ = scene().pack()
    padded, wide, _ = scene().pack(size=PaddedSize(3, 8, 15, 3, samples=5))
    assert float(run(padded, wide).energy) == pytest.approx(float(run(problem, state).energy), rel=1e-9)
