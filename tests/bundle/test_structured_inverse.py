"""Derivatives and covariances found with the structure of a linear solver are those of the dense matrix."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmark_modules import benchmark
from vggtgeo.solvers.adjoint import exact_model
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, ConjugateGradients
from vggtgeo.solvers.covariance import ArrowCovariance, covariance
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky
from vggtgeo.solvers.schur_complement import dense_schur_complement

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import solve
from vggtgeo.bundle.solver_choice import coupled_pairs, longest, narrow_order

loop = benchmark("simulated_loop")

KEYFRAMES = 30
WINDOW, SURFACES = loop.simulate_loop(KEYFRAMES, points=6, reach=2, drift=0.3)
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
        return PROBLEM.with_term(none(PROBLEM.terms["depth"])).with_term(none(PROBLEM.terms["surfaces"]), replace=True)
    if name == "cut":
        edges = (PROBLEM.edges.source == 7) | (PROBLEM.edges.target == 7)
        points = PROBLEM.terms["points"].reweighted(jnp.where(edges[:, None], 0.0, PROBLEM.terms["points"].weight))
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
    problem = eqx.tree_at(lambda p: (p.terms["surfaces"].measured, p.terms["depth"].mean), PROBLEM, moving)
    iteration = SchurLevenbergMarquardt(rtol=1e-12, max_iterations=10, reduced_solver=solver)
    state = solve(problem, start, solver=iteration).state
    return jnp.sum(jnp.sin(state.poses.wxyz_xyz)) + jnp.sum(state.inverse_depth**2) + jnp.sum(state.intrinsics)


MOVING = (SURFACES.measured, PROBLEM.terms["depth"].mean)


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
