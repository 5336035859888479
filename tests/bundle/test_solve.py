"""`solve`: it finds the truth, says how it ended, and is a pure function under JAX's transformations."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from reported import raises
from scenes import Scene, make_scene
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve

EXACT = make_scene()
NOISY = make_scene(noise=0.5, outliers=0.15, depth_error=0.05, seed=2)
OPTIONS = {"fixed": np.array([False, False, False, True])}
SOLVER = SchurLevenbergMarquardt(rtol=1e-12, max_iterations=40)
Solve = Callable[[Problem, State], Solution]


@pytest.fixture(scope="module")
def solved() -> Solve:
    """`solve`, compiled once for all tests of this file."""
    return jax.jit(lambda problem, state: solve(problem, state, solver=SOLVER))


def exact_problem(scene: Scene = EXACT) -> tuple[Problem, State, State]:
    """A problem whose optimum is known, the guess, and the truth."""
    problem, truth, _ = scene.at_truth(**OPTIONS)
    _, start, _ = scene.pack(**OPTIONS)
    held = start.intrinsics.at[3].set(truth.intrinsics[3])
    return problem, State(start.poses, held, start.inverse_depth), truth


def distance(found: State, truth: State) -> float:
    """Largest difference of poses (metres, radians), relative intrinsics and relative depths."""
    tangents = (found.poses @ truth.poses.inverse()).log()
    relative = lambda a, b: jnp.abs(a / b - 1).max()
    depth = relative(found.inverse_depth, truth.inverse_depth)
    return float(max(jnp.abs(tangents).max(), relative(found.intrinsics, truth.intrinsics), depth))


def finite(solution: Solution) -> bool:
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves((solution.state, solution.energy)))


def test_exact_observations_give_the_truth(solved: Solve) -> None:
    # Proves that points, lines and depths pull to one optimum. Oracle: the scene that the observations came from.
    problem, start, truth = exact_problem()
    solution = solved(problem, start)
    assert distance(start, truth) > 1e-2
    assert distance(solution.state, truth) < 1e-8
    assert float(solution.energy) < 1e-18
    assert bool(solution.converged), solution.message


def test_what_the_solution_reports(solved: Solve) -> None:
    # Proves counts, history and codes on a noisy problem. Oracle: what each of them is defined to be.
    problem, start, _ = NOISY.pack(**OPTIONS)
    solution = solved(problem, start)
    steps, history = int(solution.iterations), np.asarray(solution.history)
    assert solution.result == "energy_converged"
    assert solution.message.startswith("Converged")
    assert 3 < steps < 40
    assert 0 < int(solution.linearisations) <= steps
    assert np.all(np.isfinite(history[: steps + 1]))
    assert np.all(np.isnan(history[steps + 1 :]))
    assert np.all(np.diff(history[: steps + 1]) <= 0)
    assert history[steps] == float(solution.energy)
    assert 0 < float(solution.gradient_norm) < 1e-3


def test_a_record_of_the_iterations_changes_nothing(solved: Solve) -> None:
    # Proves that a record starts at the start, ends at the solution, moves only where a step was taken, and that the
    # solution is the same without it. Oracle: the solve that keeps no record, and the rule of acceptance.
    problem, start, _ = NOISY.pack(**OPTIONS)
    recording = replace(SOLVER, record_iterations=True)
    kept, plain = jax.jit(lambda p, s: solve(p, s, solver=recording))(problem, start), solved(problem, start)
    record, steps = kept.record, int(kept.iterations)
    assert plain.record is None
    assert record is not None
    assert steps == int(plain.iterations)
    np.testing.assert_allclose(kept.state.poses.wxyz_xyz, plain.state.poses.wxyz_xyz, atol=1e-10)
    np.testing.assert_array_equal(record.moved[0], start.poses.wxyz_xyz)
    np.testing.assert_array_equal(record.moved[steps], kept.state.poses.wxyz_xyz)
    assert float(record.damping[1]) == recording.initial_damping
    assert float(record.gradient_norm[steps]) == float(kept.gradient_norm)
    moved = np.any(np.asarray(record.moved[1:] != record.moved[:-1]), axis=(1, 2))[:steps]
    np.testing.assert_array_equal(moved, np.asarray(record.gain[1 : steps + 1]) > 1e-3)
    assert np.isnan(np.asarray(record.gain[steps + 1 :])).all()


@pytest.mark.parametrize("spoil", ["pose", "pixel", "target", "weight", "no weight", "negative weight", "depth"])
def test_input_that_is_not_finite(solved: Solve, spoil: str) -> None:
    # Proves that NaN anywhere in use ends at once, with the code that says so and the initial state untouched.
    problem, start, _ = NOISY.pack(**OPTIONS)
    nan = lambda tree, where: eqx.tree_at(where, tree, replace_fn=lambda leaf: leaf.at[(0,) * leaf.ndim].set(jnp.nan))
    seen = tuple(np.argwhere(problem.terms["points"].weight > 0)[0])
    if spoil == "pose":
        start = State(jaxlie.SE3(start.poses.wxyz_xyz.at[1, 4].set(jnp.nan)), start.intrinsics, start.inverse_depth)
    elif spoil == "depth":
        start = nan(start, lambda s: s.inverse_depth)
    elif spoil == "pixel":
        problem = nan(problem, lambda p: p.pixels)
    elif spoil == "target":
        target = lambda p: p.terms["points"].target
        problem = eqx.tree_at(target, problem, replace_fn=lambda leaf: leaf.at[seen].set(jnp.nan))
    else:
        value = {"weight": jnp.inf, "no weight": jnp.nan, "negative weight": -1.0}[spoil]
        weight = lambda p: p.terms["points"].weight
        problem = eqx.tree_at(weight, problem, replace_fn=lambda leaf: leaf.at[seen].set(value))
    solution = solved(problem, start)
    assert solution.result == "nonfinite_input"
    assert int(solution.iterations) == 0
    assert not bool(solution.converged)
    np.testing.assert_array_equal(solution.state.inverse_depth, start.inverse_depth)
    np.testing.assert_array_equal(solution.state.poses.wxyz_xyz, start.poses.wxyz_xyz)


def test_a_step_that_is_not_finite(solved: Solve) -> None:
    # Proves that equations beyond the range of numbers end as a failure, not as convergence, with a finite state.
    problem, start, _ = NOISY.pack(**OPTIONS)
    problem = eqx.tree_at(lambda p: p.terms["depth"].mean, problem, start.inverse_depth)
    sigma = lambda p: p.terms["depth"].sigma
    solution = solved(eqx.tree_at(sigma, problem, replace_fn=lambda leaf: leaf * 1e-200), start)
    assert solution.result == "nonfinite_step"
    assert not bool(solution.converged)
    assert finite(solution)


def test_without_depth_the_scale_is_held(solved: Solve) -> None:
    # Proves that with no metric depth the scale stays that of the start instead of drifting, and all else is found.
    # Oracle: the truth of all that was matched, brought to the solution's scale by its translations.
    scene = EXACT.with_observations(depth_weight=0 * EXACT.observations.depth_weight)
    problem, start, truth = exact_problem(scene)
    solution = solved(problem, start)
    scale = float(jnp.linalg.norm(solution.state.poses.translation()) / jnp.linalg.norm(truth.poses.translation()))
    size = float(jnp.linalg.norm(start.poses.translation()) / jnp.linalg.norm(truth.poses.translation()))
    weights = jnp.concatenate([problem.terms["points"].weight, problem.terms["lines"].weight], 1)
    seen = jnp.any((weights > 0).reshape(3, 2, -1), 1)
    rescaled = State(
        jaxlie.SE3(solution.state.poses.wxyz_xyz.at[:, 4:].divide(scale)),
        solution.state.intrinsics,
        jnp.where(seen, solution.state.inverse_depth * scale, truth.inverse_depth),
    )
    assert finite(solution)
    assert bool(solution.converged), solution.message
    assert distance(rescaled, truth) < 1e-8
    assert abs(scale / size - 1) < 0.05


def test_two_keyframes_that_start_at_the_same_place(solved: Solve) -> None:
    # Proves that a vanishing baseline, where depth has no influence, is no end: the gradient of the poses counts.
    # Oracle: the truth.
    problem, start, truth = exact_problem()
    together = jaxlie.SE3(jnp.broadcast_to(start.poses.wxyz_xyz[:1], start.poses.wxyz_xyz.shape))
    no_depth = eqx.tree_at(lambda p: p.terms["depth"].weight, problem, replace_fn=jnp.zeros_like)
    solution = solved(no_depth, State(together, start.intrinsics, truth.inverse_depth))
    assert int(solution.iterations) > 1, solution.message
    assert float(solution.energy) < 1e-3 * float(solution.history[0])


def test_without_jit_it_is_the_same(solved: Solve) -> None:
    # Proves that compilation changes no step, and that a budget that is too small is said. Oracle: the compiled run.
    problem, start, _ = NOISY.pack(**OPTIONS)
    compiled = solved(problem, start)
    two = solve(problem, start, solver=SchurLevenbergMarquardt(rtol=1e-12, max_iterations=2))
    assert two.result == "max_iterations"
    assert int(two.iterations) == 2
    assert not bool(two.converged)
    np.testing.assert_allclose(two.history, compiled.history[:3], rtol=1e-12)
    assert solve(problem, start, solver=SchurLevenbergMarquardt(max_iterations=0)).result == "max_iterations"


def test_a_jitted_function_may_close_over_the_problem(solved: Solve) -> None:
    """Only the start is an argument, as in a notebook: the problem has values to look at, and the graph chooses the
    linear algebra. Oracle: the problem as an argument.
    """
    problem, start, truth = exact_problem()
    found = jax.jit(lambda state: solve(problem, state))(start)
    assert distance(found.state, truth) < 1e-8
    weightless = jax.tree.map(jnp.zeros_like, problem.terms["points"].weight)
    nothing = problem.with_terms((replace(problem.terms["points"], weight=weightless),))
    with raises("`problem`", "weights"):
        jax.jit(lambda state: solve(nothing, state))(start)


def test_float32_is_close_to_float64(solved: Solve) -> None:
    # Proves that a float32 problem stays float32 and loses precision only. Oracle: the float64 solution.
    exact, single = (solved(*NOISY.pack(dtype=dtype, **OPTIONS)[:2]) for dtype in (np.float64, np.float32))
    dtypes = {leaf.dtype for leaf in jax.tree.leaves(single) if jnp.issubdtype(leaf.dtype, jnp.floating)}
    assert dtypes == {np.dtype(np.float32)}
    assert bool(single.converged), single.message
    assert float(single.energy) == pytest.approx(float(exact.energy), rel=1e-5)
    assert distance(single.state, exact.state) < 2e-3
