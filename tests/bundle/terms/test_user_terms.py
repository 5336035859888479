"""A user's own residuals: each is one small class, and everything that is done with a problem works with it."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arrow_systems import check_exact_hessian
from own_terms import with_own_terms

import vggtgeo as vg

SOLVER = vg.SchurLevenbergMarquardt(rtol=1e-12, max_iterations=40)


@pytest.fixture(scope="module")
def own() -> tuple[vg.Problem, vg.State, vg.State]:
    return with_own_terms()


@pytest.fixture(scope="module")
def solved(own: tuple[vg.Problem, vg.State, vg.State]) -> vg.Solution:
    return eqx.filter_jit(vg.solve)(own[0], own[1], solver=SOLVER)


def without(problem: vg.Problem, *names: str) -> vg.Problem:
    """The problem with the weights of these terms zero: of the same structure, so nothing is compiled again."""
    for name in names:
        term = problem.terms[name]
        problem = problem.with_term(term.reweighted(0 * term.weight), replace=True)
    return problem


def test_a_residual_that_is_written_is_the_residual_that_is_solved(own, solved) -> None:
    # Proves that own terms move the optimum: from 1 cm off, exact fixes bring the centres to the truth. Oracle: truth.
    problem, initial, truth = own
    off = lambda state: float(jnp.abs(state.poses.inverse().translation() - truth.poses.inverse().translation()).max())
    assert off(initial) > 5e-3
    assert off(solved.state) < 1.5e-3, off(solved.state)
    silent = without(problem, "position_fix", "point_to_plane", "step_of_wheels")
    assert off(eqx.filter_jit(vg.solve)(silent, initial, solver=SOLVER).state) > 2 * off(solved.state)


@pytest.mark.long
def test_second_derivatives_are_derived(own) -> None:
    # Proves gradient and exact Hessian with own terms of three kinds and an own kernel. Oracle: automatic
    # differentiation of the energy after a retraction.
    problem, state, _ = own
    problem = problem.without_term("points").without_term("lines")  # tests/bundle/test_linearise.py has theirs
    check_exact_hessian(problem, state, vg.energy)


@pytest.mark.long
def test_gradient_by_own_data(own) -> None:
    # Proves that the optimum is differentiated by the data of a user's term, under `vmap` too. Oracle: finite
    # differences of the solve.
    problem, initial, _ = own
    for name in ("lines", "step_of_wheels", "point_to_plane"):  # few terms compile quickly
        problem = problem.without_term(name)
    get = lambda p: p.terms["position_fix"].position

    def loss(position: jax.Array) -> jax.Array:
        moved = eqx.tree_at(get, problem, position)
        return jnp.sum(jnp.sin(3 * vg.solve(moved, initial, solver=SOLVER).state.poses.wxyz_xyz))

    value_and_gradient = jax.jit(jax.vmap(jax.value_and_grad(loss)))
    along = np.random.default_rng(0).normal(size=get(problem).shape)
    steps = jnp.asarray([0.0, 1e-4, -1e-4])
    values, gradients = value_and_gradient(get(problem) + steps[:, None, None] * along)
    difference = float(values[1] - values[2]) / 2e-4
    found = float(jnp.sum(gradients[0] * along))
    assert abs(found - difference) < 1e-5 * abs(difference), (found, difference)
