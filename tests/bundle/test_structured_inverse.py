"""Derivatives and covariances found with the structure of a linear solver are those of the dense matrix."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vggtgeo.solvers.adjoint import STATIONARY, ArrowAdjoint
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, dense_schur_complement
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.block_band import BandMatrix, BandVector
from vggtgeo.solvers.block_elimination import eliminate, selected_inverse, solve_eliminated
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, ConjugateGradients
from vggtgeo.solvers.covariance import ArrowCovariance, covariance
from vggtgeo.solvers.exact_model import exact_model
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.minres import minres
from vggtgeo.solvers.reduced import AbstractReducedSolver, DenseCholesky

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.node_order import longest, narrow_order
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import solve
from vggtgeo.bundle.solver_choice import coupled_pairs
from vggtgeo.simulation.loop import simulate_loop

KEYFRAMES = 30
WINDOW, SURFACES = simulate_loop(KEYFRAMES, points=6, reach=2, drift=0.3)
PROBLEM, INITIAL, _ = WINDOW.pack(intrinsics=Intrinsics(WINDOW.intrinsics, prior_sigma=2.0), terms=(SURFACES,))
ENDS, _ = coupled_pairs(PROBLEM)
PLACE = narrow_order(KEYFRAMES, ENDS)
BAND = BandCholesky(longest(PLACE, ENDS), jnp.asarray(PLACE))
ITERATIVE = ConjugateGradients(BandPreconditioner(2))
SOLVERS: dict[str, tuple[AbstractReducedSolver, float]] = {"band": (BAND, 1e-9), "minimum residuals": (ITERATIVE, 1e-7)}
"""With the accuracy that is claimed, relative to the largest entry."""
Tree = Any


@pytest.fixture(scope="module")
def solved() -> State:
    """The loop, adjusted by the band."""
    iteration = SchurLevenbergMarquardt(rtol=1e-12, reduced_solver=BAND)
    return eqx.filter_jit(solve)(PROBLEM, INITIAL, solver=iteration).state


@jax.jit
def linearised(problem: Problem, state: State) -> ArrowSystem:
    return BundleAdjustment(problem).linearise(state)


@jax.jit
def exact(problem: Problem, state: State) -> ArrowSystem:
    return BundleAdjustment(problem).hessian(state)


def worst(found: Tree, expected: Tree) -> float:
    """Largest difference of any leaf where the expected one is finite, relative to its largest entry."""
    errors = [0.0]
    for one, other in zip(*(map(np.asarray, jax.tree.leaves(tree)) for tree in (found, expected)), strict=True):
        known = np.isfinite(other)
        np.testing.assert_array_equal(np.isfinite(one), known)
        if known.any():
            errors.append(np.abs(one[known] - other[known]).max() / max(np.abs(other[known]).max(), 1e-300))
    return float(max(errors))


def test_a_loop_is_closed(solved: State) -> None:
    # Proves that the folded band adjusts a loop that starts open. Oracle: the truth.
    assert np.sqrt(np.mean(WINDOW.errors(INITIAL) ** 2)) > 0.1
    assert np.sqrt(np.mean(WINDOW.errors(solved) ** 2)) < 0.03
    assert longest(np.arange(KEYFRAMES), ENDS) == KEYFRAMES - 1


@eqx.filter_jit
def solve_exactly(
    solver: AbstractReducedSolver, system: ArrowSystem, definite: ArrowSystem, vector: ArrowVector
) -> Any:
    return exact_model(system, solver, lambda: definite).solve(vector)


@pytest.mark.long
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("definite", [True, False])
def test_exact_hessians_are_solved(name: str, definite: bool, solved: State) -> None:
    # Proves the solve of implicit differentiation: of the exact Hessian at an optimum, and of one whose surfaces push
    # instead of pull. Oracle: the dense LU factor, and the signs of the dense matrix's eigenvalues.
    solver, tolerance = SOLVERS[name]
    system, near = exact(PROBLEM, solved), linearised(PROBLEM, solved)
    if not definite:
        assert system.factors is not None
        system = eqx.tree_at(lambda s: s.factors.hessian, system, -3 * system.factors.hessian)
    reduced = jax.jit(dense_schur_complement)(system)
    free = np.ix_(system.free, system.free)
    scale = np.sqrt(np.diag(reduced.hessian)[system.free]) if definite else 1.0
    least = np.linalg.eigvalsh(np.asarray(reduced.hessian - reduced.schur)[free] / scale / np.reshape(scale, (-1, 1)))[
        0
    ]
    assert (least > 0) == definite
    rng = np.random.default_rng(0)
    vector = ArrowVector(*(jnp.asarray(rng.normal(size=part.shape)) for part in (system.free, system.cross[:, -1])))
    expected = solve_exactly(DenseCholesky(), system, near, vector)
    assert worst(solve_exactly(solver, system, near, vector), expected) < tolerance


@pytest.mark.parametrize(("iterations", "ended"), [(2, False), (2000, True)])
def test_a_solve_that_ends_too_early_says_so(iterations: int, ended: bool, solved: State) -> None:
    # Proves that minimum residuals without convergence are known. Oracle: the residual of the dense matrix.
    system = linearised(PROBLEM, solved)
    solver = ConjugateGradients(BandPreconditioner(2), exact_iterations=iterations)
    rng = np.random.default_rng(0)
    vector = ArrowVector(jnp.asarray(rng.normal(size=system.free.shape)), jnp.zeros_like(system.cross[:, -1]))
    step, told = eqx.filter_jit(lambda s, v: exact_model(s, solver).checked(v))(system, vector)
    reduced = jax.jit(dense_schur_complement)(system)
    off = np.where(system.free, (reduced.hessian - reduced.schur) @ step.dense - vector.dense, 0.0)
    assert bool(told) == ended
    assert (np.abs(off).max() < 1e-6) == ended


@eqx.filter_jit
def inverted(system: ArrowSystem, solver: AbstractReducedSolver, hosts: jax.Array) -> ArrowCovariance:
    return covariance(system, solver, hosts)


def changed(name: str) -> Problem:
    """The loop as it is, without anything metric, or with one keyframe cut out of it."""
    none = lambda term: term.reweighted(jnp.zeros_like(term.weight))
    if name == "free scale":
        return PROBLEM.with_term(none(PROBLEM.depth)).with_term(none(PROBLEM.surfaces), replace=True)
    if name == "cut":
        edges = (PROBLEM.edges.source == 7) | (PROBLEM.edges.target == 7)
        points = PROBLEM.points.reweighted(jnp.where(edges[:, None], 0.0, PROBLEM.points.weight))
        pairs = (SURFACES.first == 7) | (SURFACES.second == 7)
        return PROBLEM.with_term(points).with_term(
            SURFACES.reweighted(jnp.where(pairs, 0.0, SURFACES.weight)), replace=True
        )
    return PROBLEM


@pytest.mark.parametrize("name", ["whole", "free scale", "cut"])
def test_covariances_of_the_band(name: str, solved: State) -> None:
    # Proves the selected inverse for every pose, neighbouring pair, landmark and the intrinsics: of the whole loop,
    # with the scale held, and where a keyframe is undetermined. Oracle: the eigenvectors of the dense matrix.
    system, hosts = linearised(changed(name), solved), jnp.arange(KEYFRAMES)
    expected = inverted(system, DenseCholesky(), hosts)
    error = worst(inverted(system, BAND, hosts), expected)
    assert error < (1e-6 if name == "free scale" else 1e-9)
    assert bool(np.isinf(np.diagonal(expected.nodes[7])).all()) == (name == "cut")


@pytest.mark.parametrize("name", ["whole", "free scale"])
def test_covariances_column_by_column(name: str, solved: State) -> None:
    # Proves the covariances around some keyframes by minimum residuals. Oracle: the dense matrix.
    system, hosts = linearised(changed(name), solved), jnp.asarray([3, 29])
    expected = inverted(system, DenseCholesky(), hosts)
    assert worst(inverted(system, ITERATIVE, hosts), expected) < (1e-5 if name == "free scale" else 1e-8)


def loss(moving: tuple[jax.Array, jax.Array], solver: AbstractReducedSolver, start: State) -> jax.Array:
    """A number that depends on all that is estimated, as a function of the surfaces and the depth priors."""
    problem = eqx.tree_at(lambda p: (p.surfaces.measured, p.depth.mean), PROBLEM, moving)
    iteration = SchurLevenbergMarquardt(rtol=1e-12, max_iterations=10, reduced_solver=solver)
    state = solve(problem, start, solver=iteration).state
    return jnp.sum(jnp.sin(state.poses.wxyz_xyz)) + jnp.sum(state.inverse_depth**2) + jnp.sum(state.intrinsics)


MOVING = (SURFACES.measured, PROBLEM.depth.mean)


@pytest.fixture(scope="module")
def by_dense(solved: State) -> Tree:
    return eqx.filter_jit(jax.grad(loss))(MOVING, DenseCholesky(), solved)


@pytest.mark.slow  # half a minute of compilation each; `test_exact_hessians_are_solved` is the solve that they need
@pytest.mark.parametrize("name", SOLVERS)
def test_gradients_in_reverse_mode(name: str, solved: State, by_dense: Tree) -> None:
    # Proves the derivative of the optimum with the solver's own structure. Oracle: the dense factor.
    solver, tolerance = SOLVERS[name]
    found = eqx.filter_jit(jax.grad(loss))(MOVING, solver, solved)
    assert worst(found, by_dense) < tolerance


@pytest.mark.slow  # a minute of compilation; test_single_leaves.py has the same of the dense way
def test_a_derivative_whose_system_was_not_solved_can_be_refused(solved: State) -> None:
    # Proves that a derivative is NaN where it is asked for and its linear system was not solved, though the point is an
    # optimum. Oracle: two iterations cannot be enough, see above.
    solver = ConjugateGradients(BandPreconditioner(2), exact_iterations=2)
    iteration = SchurLevenbergMarquardt(rtol=1e-12, max_iterations=1, reduced_solver=solver)

    def value(mean: jax.Array) -> tuple[jax.Array, jax.Array]:
        problem = eqx.tree_at(lambda p: p.depth.mean, PROBLEM, mean)
        found = solve(problem, solved, solver=iteration, adjoint=ArrowAdjoint(not_stationary="nan"))
        return jnp.sum(found.state.inverse_depth), found.gradient_residual

    gradient, residual = jax.jit(jax.grad(value, has_aux=True))(PROBLEM.depth.mean)
    assert float(residual) < STATIONARY
    assert bool(jnp.isnan(gradient).any())


@pytest.mark.slow
def test_gradients_in_forward_mode(solved: State, by_dense: Tree) -> None:
    # Proves that the band's derivative is the same forward. Oracle: the dense gradient, along a random direction.
    rng = np.random.default_rng(1)
    along = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), MOVING)
    forward: Callable = lambda moving: jax.jvp(lambda m: loss(m, BAND, solved), (moving,), (along,))[1]
    expected = sum(float(jnp.vdot(a, b)) for a, b in zip(by_dense, along, strict=True))
    assert float(jax.jit(forward)(MOVING)) == pytest.approx(expected, rel=1e-9)


def random_band(rng: np.random.Generator, definite: bool) -> tuple[BandMatrix, np.ndarray]:
    """Three groups of four coordinates and a border of two, and the same as a dense matrix."""
    size = 14
    near = np.abs(np.arange(size)[:, None] // 4 - np.arange(size) // 4) <= 1
    near[12:], near[:, 12:] = True, True
    dense = rng.normal(size=(size, size))
    dense = (dense + dense.T) * near
    dense += np.diag(10.0 * (np.ones(size) if definite else np.where(np.arange(size) % 3, 1.0, -1.0)))
    groups = np.zeros((3, 2, 4, 4))
    for k in range(3):
        groups[k, 0] = dense[4 * k : 4 * k + 4, 4 * k : 4 * k + 4]
        groups[k, 1] = dense[4 * k + 4 : 4 * k + 8, 4 * k : 4 * k + 4] if k < 2 else 0
    border = dense[:12, 12:].reshape(3, 4, 2)
    return BandMatrix(*(jnp.asarray(part) for part in (groups, border, dense[12:, 12:]))), dense


def columns_of(values: np.ndarray) -> BandVector:
    return BandVector(jnp.asarray(values[:12].reshape(3, 4, -1)), jnp.asarray(values[12:]))


@pytest.mark.parametrize("definite", [True, False])
def test_elimination_of_a_band(definite: bool) -> None:
    # Proves solves and inverse blocks of matrices with eigenvalues of both signs, with held coordinates and a scale.
    # Oracle: numpy's inverse.
    rng = np.random.default_rng(3)
    matrix, dense = random_band(rng, definite)
    assert (np.linalg.eigvalsh(dense).min() > 0) == definite
    free = np.arange(14) != 5
    inverse = np.zeros((14, 14))
    inverse[np.ix_(free, free)] = np.linalg.inv(dense[np.ix_(free, free)])
    scale = rng.uniform(1, 3, (14, 1))
    found = eliminate(matrix, columns_of(free[:, None]), columns_of(scale), 1e-12)
    rhs = np.where(free[:, None], rng.normal(size=(14, 2)), 0.0)
    got = solve_eliminated(found, columns_of(rhs))
    np.testing.assert_allclose(np.concatenate([got.nodes.reshape(12, 2), got.shared]), inverse @ rhs, atol=1e-12)
    known, unknown = selected_inverse(found)
    sizes = np.where(free[:, None], scale, 1.0)
    expected = inverse * sizes * sizes.T + np.diag(~free)
    np.testing.assert_allclose(known.groups[1, 0], expected[4:8, 4:8], atol=1e-12)
    np.testing.assert_allclose(known.groups[1, 1], expected[8:12, 4:8], atol=1e-12)
    np.testing.assert_allclose(known.border[0], expected[:4, 12:], atol=1e-12)
    np.testing.assert_allclose(known.corner, expected[12:, 12:], atol=1e-12)
    assert int(found.rank) == 14
    assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(unknown)) == 0.0


def test_minimum_residuals_at_a_saddle() -> None:
    # Proves the solution of an indefinite system with a definite preconditioner. Oracle: numpy's solve.
    rng = np.random.default_rng(0)
    _, matrix = random_band(rng, False)
    rhs, diagonal = jnp.asarray(rng.normal(size=14)), jnp.asarray(np.abs(np.diag(matrix)))
    found = jax.jit(lambda b: minres(lambda x: jnp.asarray(matrix) @ x, lambda r: r / diagonal, b, 1e-13, 50))(rhs)
    assert bool(found.converged)
    np.testing.assert_allclose(found.solution, np.linalg.solve(matrix, rhs), atol=1e-11)
