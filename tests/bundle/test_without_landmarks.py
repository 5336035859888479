"""Poses that epipolar terms alone tie together, without a landmark: the scale is free, and held."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BlockJacobi, ConjugateGradients
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky

import vggtgeo as vg
from vggtgeo.bundle.linearise import scale_direction
from vggtgeo.bundle.problem import Problem, State


class Epipolar(vg.terms.PairTerm):
    """A match as a constraint on two poses, which the length of the baseline does not enter."""

    host: jax.Array
    target: jax.Array

    def residual(self, first: jaxlie.SE3, second: jaxlie.SE3) -> jax.Array:
        motion = second @ first.inverse()
        baseline = motion.translation() / jnp.linalg.norm(motion.translation())
        row = self.target @ jnp.cross(baseline, motion.rotation().as_matrix() @ self.host)
        return row.astype(self.host.dtype)  # the inverse of a float32 pose is float64 in jaxlie, where x64 is on


def poses_alone(dtype: type = np.float64) -> tuple[Problem, State]:
    """A problem of epipolar terms of some hundred matches, and its guess."""
    window = vg.simulate_window(4, points=20, lines=0, start_error=0.01)
    seen, (focal, centre) = window.observations, np.split(window.intrinsics, 2)
    ray = lambda pixel: np.column_stack([(pixel - centre) / focal, np.ones(len(pixel))])
    first, second = seen.edges[seen.point_edge].T
    term = Epipolar(
        first=first,
        second=second,
        host=jnp.asarray(ray(seen.pixel[seen.point_landmark]), dtype),
        target=jnp.asarray(ray(seen.point_target), dtype),
        weight=jnp.full(len(first), (focal[0] / window.sigma) ** 2, dtype),
    )
    none, nowhere = np.zeros(0, int), np.zeros((0, 2))
    empty = vg.Observations(np.zeros((0, 2), int), none, nowhere, none, none, nowhere, np.zeros(0))
    problem, initial, _ = vg.pack(
        empty,
        window.start,
        vg.cameras.Intrinsics(window.intrinsics, fixed=True),
        np.zeros(0),
        terms=[term],
        dtype=dtype,
    )
    return problem, initial


@pytest.fixture(scope="module")
def solved() -> tuple[Problem, State, np.ndarray]:
    """The problem, a state near its solution, and the dense covariance there with the scale held."""
    problem, state = poses_alone()
    size = 6 * problem.num_keyframes
    rows = lambda step: vg.residuals_at(problem, state.moved(jnp.pad(step, (0, 4))))["epipolar"]
    jacobian = np.asarray(jax.jit(jax.jacfwd(rows))(jnp.zeros(size)))[:, 6:]
    information = jacobian.T @ (np.asarray(problem.terms["epipolar"].weight)[:, None] * jacobian)
    scale = np.asarray(scale_direction(problem, state))[6:size]
    basis = np.linalg.svd(scale.T)[2][1:].T
    return problem, state, basis @ np.linalg.inv(basis.T @ information @ basis) @ basis.T


SOLVERS = [DenseCholesky(), BandCholesky(3), ConjugateGradients(BlockJacobi())]


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_covariances_without_landmarks_hold_the_scale(
    solved: tuple[Problem, State, np.ndarray], solver: AbstractReducedSolver
) -> None:
    """Poses that epipolar terms alone determine have the finite covariances of the solution with its scale held, and
    their rank is one less than what is free. Oracle: the dense inverse on what is orthogonal to the scale, with a
    Jacobian by automatic differentiation of all residuals together.
    """
    problem, state, dense = solved
    found = vg.covariances(problem, state, reduced_solver=solver)
    for i in range(1, problem.num_keyframes):
        expected = dense[6 * i - 6 : 6 * i, 6 * i - 6 : 6 * i]
        spread = np.sqrt(np.diag(expected))
        error = np.abs(found.poses[i] - expected) / spread[:, None] / spread
        assert error.max() < 1e-6, f"keyframe {i}: off by {error.max():.1e} of its variances"
    rows, unknowns = problem.terms["epipolar"].weight.size, 6 * (problem.num_keyframes - 1) - 1
    factor = 2 * vg.energy(problem, state) / (rows - unknowns)
    assert float(found.variance_factor) == pytest.approx(float(factor), rel=1e-9)


def test_single_precision_finds_the_same_free_scale(solved: tuple[Problem, State, np.ndarray]) -> None:
    """In float32, too, the scale's curvature is seen to be rounding error. Oracle: the dense inverse, in float64."""
    found = vg.covariances(*poses_alone(np.float32))
    spread = np.sqrt(np.diagonal(np.asarray(found.poses, float), axis1=1, axis2=2))[1:].reshape(-1)
    np.testing.assert_allclose(spread, np.sqrt(np.diag(solved[2])), rtol=0.02)


def test_a_scale_that_a_baseline_fixes_is_not_held(solved: tuple[Problem, State, np.ndarray]) -> None:
    """With one length known, the covariance contains that of the scale: along it the centres are as uncertain as the
    length. Oracle: the standard deviation that was stated.
    """
    problem, state, _ = solved
    centres = np.asarray(state.poses.inverse().translation())
    length, sigma = np.linalg.norm(centres[1] - centres[0]), 0.3
    known = vg.terms.BaselinePrior(
        first=[0], second=[1], length=jnp.array([length]), sigma=jnp.array([sigma]), weight=jnp.ones(1)
    )
    found = np.asarray(vg.covariances(problem.with_term(known), state).poses[1])[:3, :3]
    outward = np.asarray(state.poses.translation())[1] / length
    assert np.sqrt(outward @ found @ outward) == pytest.approx(sigma * length, rel=1e-3)
