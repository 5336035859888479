"""A factor on all weights, however small, changes neither the optimum, nor the way to it, nor derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sequence_problems import REACH, TIGHT, packed, sequence
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BlockJacobi, ConjugateGradients
from vggtgeo.solvers.kernels import Square
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced import AbstractReducedSolver

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve

TINY = 1e-40
SOLVERS = {"band": BandCholesky(REACH), "blocks": ConjugateGradients(BlockJacobi(), **TIGHT)}


def times(problem: Problem, factor: float | jax.Array) -> Problem:
    """All weights `factor` times as large."""
    terms = [term for term in problem.terms if hasattr(term, "weight")]
    scaled = [eqx.tree_at(lambda t: t.weight, term, term.weight * factor) for term in terms]
    return problem.with_terms(tuple(scaled))


def depths(target: jax.Array, factor: jax.Array, problem: Problem, start: State) -> tuple[jax.Array, Solution]:
    """The sum of all inverse depths that these targets give, and the solution."""
    points = eqx.tree_at(lambda points: points.target, problem.points, target)
    solution = solve(times(problem.with_term(points), factor), start, solver=SchurLevenbergMarquardt())
    return solution.state.inverse_depth.sum(), solution


def check_same(tiny: Solution, ordinary: Solution) -> None:
    """As many steps to the same state."""
    assert tiny.result == ordinary.result == "energy_converged"
    assert int(tiny.iterations) == int(ordinary.iterations) > 3
    np.testing.assert_allclose(tiny.state.poses.wxyz_xyz, ordinary.state.poses.wxyz_xyz, atol=1e-9)
    np.testing.assert_allclose(tiny.energy / TINY, ordinary.energy, rtol=1e-9)


def test_tiny_weights_ask_for_the_same_steps() -> None:
    """With squared residuals a factor drops out of the normal equations: 1e-40 in place of 1 takes as many steps to the
    same state, with the same derivatives (nothing was moved, "gradient_converged"). Oracle: the factor 1.
    """
    problem, start = packed(sequence(), kernel=Square())
    derivative = jax.jit(jax.grad(depths, has_aux=True))
    expected, ordinary = derivative(problem.points.target, jnp.asarray(1.0), problem, start)
    found, tiny = derivative(problem.points.target, jnp.asarray(TINY), problem, start)
    check_same(tiny, ordinary)
    np.testing.assert_allclose(found, expected, atol=1e-6 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("reduced", SOLVERS.values(), ids=SOLVERS)
def test_so_it_is_with_every_linear_solver(reduced: AbstractReducedSolver) -> None:
    """Band and conjugate gradients floor the diagonal in proportion, too; oracle: the factor 1."""
    problem, start = packed(sequence(), kernel=Square())
    solver = SchurLevenbergMarquardt(reduced_solver=reduced)
    solved = jax.jit(lambda factor: solve(times(problem, factor), start, solver=solver))
    check_same(solved(TINY), solved(1.0))
