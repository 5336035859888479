"""Derivatives by one leaf alone, of any order, at a bound, and which of optimistix's adjoints `solve` takes."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from priors import prior_on
from scenes import make_scene
from vggtgeo.solvers.adjoint import STATIONARY, ArrowAdjoint
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

import vggtgeo as vg
from vggtgeo.bundle.linearise import MIN_INVERSE_DEPTH
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve

SCENE = make_scene(2, 6, 0, noise=0.5, depth_error=0.05, seed=4)
SOLVER = SchurLevenbergMarquardt(rtol=1e-9, max_iterations=40)
Leaf = Callable[[Problem], Any]

LEAVES = {"alpha": lambda p: p.terms["depth"].alpha, "marginal root": lambda p: p.terms["marginal"].root}
"""A leaf that touches landmarks only, and one of poses and camera only."""


def made() -> tuple[Problem, State]:
    """A problem whose prior stands where the poses start, as after a marginalisation."""
    problem, state, _ = SCENE.pack()
    prior = prior_on(state, 2.0)
    return problem.with_term(eqx.tree_at(lambda term: term.poses, prior, state.poses)), state


def loss(problem: Problem, state: State, **options: Any) -> jax.Array:
    found = solve(problem, state, solver=SOLVER, **options).state
    return jnp.sum(jnp.sin(3 * found.poses.wxyz_xyz)) + jnp.sum(found.inverse_depth**2) + 1e-2 * found.intrinsics[0]


@pytest.fixture(scope="module")
def by_all() -> Problem:
    """The gradient by all leaves at once."""
    problem, state = made()
    return eqx.filter_jit(eqx.filter_grad(loss))(problem, state)


@pytest.mark.slow  # half a minute of compilation each; test_learning.py differentiates by one leaf, too
@pytest.mark.parametrize("name", LEAVES)
def test_one_leaf_alone(name: str, by_all: Problem) -> None:
    # Proves that a leaf which touches only landmarks, or only poses and camera, has its derivative too. Oracle: the
    # gradient by all leaves, which finite differences confirm (tests/bundle/test_gradients.py).
    problem, state = made()
    get = LEAVES[name]
    value = lambda leaf: loss(eqx.tree_at(get, problem, leaf), state)
    leaf, expected = get(problem), get(by_all)
    assert bool(jnp.all(jnp.isfinite(expected)))
    reverse = jax.jit(jax.grad(value))(leaf)
    np.testing.assert_allclose(reverse, expected, rtol=1e-6, atol=1e-9 * float(jnp.abs(expected).max()))


@pytest.mark.slow  # two minutes of compilation
def test_second_derivative() -> None:
    # Proves `grad` of `grad` through the optimum. Oracle: central differences of the gradient.
    problem, state = made()
    get = LEAVES["alpha"]
    gradient = jax.jit(jax.grad(lambda leaf: loss(eqx.tree_at(get, problem, leaf), state)))
    second = jax.jit(jax.grad(jax.grad(lambda leaf: loss(eqx.tree_at(get, problem, leaf), state))))
    alpha = get(problem)
    difference = (gradient(alpha + 1e-3) - gradient(alpha - 1e-3)) / 2e-3
    assert float(second(alpha)) == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.long
def test_a_landmark_at_its_bound_is_held() -> None:
    # Proves that a landmark which wants to lie behind infinity rests on its bound, is counted, meets the condition of
    # Karush, Kuhn and Tucker, and gives the others their right derivative. Oracle: finite differences of the solve.
    scene = make_scene(2, 6, 0, noise=0.3, seed=4)
    problem, state, _ = scene.pack(fixed=True)
    problem = eqx.tree_at(lambda p: p.terms["depth"].weight, problem, problem.terms["depth"].weight.at[0].set(0.0))
    # A match 40 pixels on the far side of infinity: along the epipolar line, against the parallax.
    off = problem.terms["points"].target.at[0, 0].add(jnp.asarray([40.0, 0.0]))
    problem = eqx.tree_at(lambda p: p.terms["points"].target, problem, off)
    tight = SchurLevenbergMarquardt(rtol=1e-14, max_iterations=60)

    get = lambda p: p.terms["points"].target

    def value(target: jax.Array) -> tuple[jax.Array, Solution]:
        solution = solve(eqx.tree_at(get, problem, target), state, solver=tight)
        return jnp.sum(jnp.sin(3 * solution.state.poses.wxyz_xyz)), solution

    # Under differentiation the value is that of the optimum after Newton steps: what the differences need.
    run = jax.jit(jax.value_and_grad(value, has_aux=True))
    (_, solution), gradient = run(get(problem))
    assert int(solution.at_bound) == 1, solution.state.inverse_depth
    assert float(solution.state.inverse_depth.min()) == MIN_INVERSE_DEPTH
    assert float(solution.gradient_norm) < STATIONARY
    along = jnp.asarray(np.random.default_rng(1).normal(size=get(problem).shape))
    (ahead, first), (behind, second) = (run(get(problem) + e * along)[0] for e in (1e-4, -1e-4))
    assert max(float(first.gradient_residual), float(second.gradient_residual)) < 1e-10
    difference = float(ahead - behind) / 2e-4
    assert float(jnp.sum(gradient * along)) == pytest.approx(difference, rel=1e-5)


@pytest.mark.long
def test_the_solution_says_that_it_was_polished() -> None:
    # Proves that under differentiation the solution tells that its state is the polished optimum, and how far it was
    # from rest; and that a derivative at a point that is none can be refused. Oracle: the definition.
    problem, state, _ = SCENE.pack(fixed=True)
    short = SchurLevenbergMarquardt(rtol=0.0, max_iterations=1)

    def value(alpha: jax.Array, **options: Any) -> tuple[jax.Array, Solution]:
        moved = eqx.tree_at(LEAVES["alpha"], problem, alpha)
        solution = solve(moved, state, solver=short, **options)
        return jnp.sum(solution.state.poses.wxyz_xyz[1]), solution

    alpha = problem.terms["depth"].alpha
    (_, told), _ = jax.jit(jax.value_and_grad(value, has_aux=True))(alpha)
    assert bool(told.polished)
    assert not bool(solve(problem, state, solver=short).polished)
    strict = ArrowAdjoint(polish=0, not_stationary="nan")
    refused = jax.jit(jax.grad(lambda alpha: value(alpha, adjoint=strict)[0]))(alpha)
    assert bool(jnp.isnan(refused))


LOOPED = vg.SchurLevenbergMarquardt(rtol=0.0, atol=0.0, max_iterations=12)


@pytest.fixture(scope="module")
def distance() -> Callable[..., jax.Array]:
    """Distance of a solution from the origin, of a small problem with its points weighted."""
    problem, initial, _ = vg.simulate_window(2, points=8, lines=0, host_noise=False).pack(kernel=vg.kernels.Square())

    def value(share: jax.Array, **options: optx.AbstractAdjoint) -> jax.Array:
        points = problem.terms["points"].reweighted(share * problem.terms["points"].weight)
        state = vg.solve(problem.with_term(points), initial, solver=LOOPED, **options).state
        return jnp.sum(state.poses.inverse().translation() ** 2)

    return value


@pytest.mark.long
def test_the_adjoint_through_the_iterates_needs_no_option_of_the_solver(distance: Callable[..., jax.Array]) -> None:
    """`RecursiveCheckpointAdjoint()` alone differentiates the iterates. Oracle: the implicit derivative, which is that
    of the limit of the iterates.
    """
    through = jax.jit(jax.grad(lambda share: distance(share, adjoint=optx.RecursiveCheckpointAdjoint())))(jnp.ones(()))
    implicit = jax.jit(jax.grad(distance))(jnp.ones(()))
    assert abs(float(implicit)) > 1e-6
    assert float(through) == pytest.approx(float(implicit), rel=1e-5)
