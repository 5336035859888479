"""A sliding window as a pure function: what leaves, what stays, and its derivative through many windows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from reported import raises
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

import vggtgeo as vg
from vggtgeo.bundle.problem import Problem, State

KEYFRAMES, WINDOWS = 4, 5
Windows = tuple[Problem, State]


def long_window(**options: Any) -> vg.data.SimulatedWindow:
    """All that any of the windows sees."""
    return vg.simulate_window(KEYFRAMES + WINDOWS - 1, **{"points": 8, "lines": 1, "noise": 0.5, "seed": 3, **options})


def stacked(seen: vg.data.SimulatedWindow, windows: Sequence[int] = range(WINDOWS)) -> Windows:
    """The windows from keyframe k on, stacked, each with an empty prior."""
    parts, intrinsics = [], vg.cameras.Intrinsics(seen.intrinsics, prior_sigma=3.0)
    for first in windows:
        inside = range(first, first + KEYFRAMES)
        own = seen.observations.within(inside)
        parts.append((own, seen.start[list(inside)], intrinsics, own.depth_mean))
    problems, initials, _ = vg.batches.pack_batch(parts, terms=[vg.empty_prior(KEYFRAMES)])
    return problems, initials


def pick(tree: Any, row: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[row], tree)


def test_the_observations_within_some_keyframes_are_theirs() -> None:
    # Proves that a window cut out, its keyframes in another order, sees what the whole sees between them. Oracle: the
    # residuals at the truth without noise, all zero, and the count.
    whole = long_window(noise=0.0, depth_error=0.0)
    chosen = [5, 2, 3]
    own = whole.observations.within(chosen)
    hosted = np.isin(whole.observations.host, chosen)
    problem, state, _ = vg.pack(own, whole.poses[chosen], whole.intrinsics, whole.inverse_depth[hosted])
    sizes = vg.analysis.residual_sizes(problem, state)
    assert float(sizes.rms["points"]) < 1e-9
    assert float(sizes.rms["lines"]) < 1e-9
    assert int(sizes.count["points"]) == 3 * 2 * 8
    assert int(sizes.count["lines"]) == 3 * 2 * 4
    for wrong in ([1, 1], np.array([0.5])):
        with raises("`keyframes`", np.asarray(wrong).tolist()):
            whole.observations.within(wrong)


@pytest.mark.parametrize("leaving", [0, 1])
def test_a_step_moves_everything_to_its_new_place(leaving: int) -> None:
    # Proves where prior, poses, camera and held poses go, under `jit` with a traced `leaving`. Oracle: `marginalise`,
    # `permute_prior` and indexing.
    problems, initials = stacked(long_window(), (0, 1))
    problem, state = pick((problems, initials), 0)
    following = pick((problems, initials), 1)
    step = jax.jit(vg.slide, static_argnames="constant_velocity")
    found, initial = step(problem, state, *following, leaving=leaving)
    staying = [place for place in range(KEYFRAMES) if place != leaving]
    expected = vg.permute_prior(jax.jit(vg.marginalise)(problem, state, leaving), np.array([*staying, -1]))
    curved = lambda prior: np.asarray(prior.root.T @ prior.root)
    prior = curved(found.terms["marginal"])
    np.testing.assert_allclose(prior, curved(expected), rtol=1e-9, atol=1e-9 * curved(expected).max())
    np.testing.assert_array_equal(found.fixed_pose, [leaving != 0, False, False, False])
    np.testing.assert_array_equal(initial.poses.wxyz_xyz[:-1], state.poses.wxyz_xyz[np.array(staying)])
    np.testing.assert_array_equal(initial.poses.wxyz_xyz[-1], following[1].poses.wxyz_xyz[-1])
    np.testing.assert_array_equal(initial.intrinsics, state.intrinsics)
    np.testing.assert_array_equal(initial.inverse_depth, following[1].inverse_depth)
    np.testing.assert_array_equal(found.terms["points"].target, following[0].terms["points"].target)
    assert jax.tree.structure((found, initial)) == jax.tree.structure((problem, state))


def test_constant_velocity_goes_on() -> None:
    # Proves the guess of the new pose. Oracle: powers of one motion.
    problems, initials = stacked(long_window(), (0, 1))
    motion = jaxlie.SE3.exp(jnp.asarray([0.1, -0.02, 0.03, 0.02, 0.05, -0.01]))
    poses = [jaxlie.SE3.identity()]
    for _ in range(KEYFRAMES):
        poses.append(motion @ poses[-1])
    every = np.stack([np.asarray(pose.wxyz_xyz) for pose in poses])
    state = State(jaxlie.SE3(jnp.asarray(every[:-1])), *jax.tree.leaves(pick(initials, 0))[1:])
    step = jax.jit(lambda *given: vg.slide(*given, constant_velocity=True))
    _, initial = step(pick(problems, 0), state, *pick((problems, initials), 1))
    np.testing.assert_allclose(initial.poses.wxyz_xyz, every[1:], atol=1e-12)


def slid(first: Problem, start: State, following: Windows, solver: SchurLevenbergMarquardt) -> State:
    """The states of all windows, each solved under the prior of those before."""

    def step(window: Windows, coming: Windows) -> tuple[Windows, State]:
        problem, initial = window
        state = vg.solve(problem, initial, solver=solver).state
        return vg.slide(problem, state, *coming), state

    states: State = jax.lax.scan(step, (first, start), following)[1]
    return states


def rolled(windows: Windows) -> Windows:
    """What follows each window; after the last, whatever it is: it is not solved."""
    return jax.tree.map(lambda leaf: jnp.roll(leaf, -1, 0), windows)


def test_slid_windows_find_the_truth() -> None:
    # Proves that the prior carries the world on: no window but the first holds a pose, and all end at the truth from
    # starts that are centimetres off. Oracle: the truth, observed without noise.
    seen = long_window(noise=0.0, depth_error=0.0)
    problems, initials = stacked(seen)
    off = np.linalg.norm(np.asarray(initials.poses.inverse().translation())[-1, -1] - seen.centres[-1])
    assert off > 0.01
    solver = SchurLevenbergMarquardt(rtol=1e-12)
    states = jax.jit(slid, static_argnums=3)(*pick((problems, initials), 0), rolled((problems, initials)), solver)
    centres = np.asarray(states.poses.inverse().translation())
    for row in range(WINDOWS):
        error = np.linalg.norm(centres[row] - seen.centres[row : row + KEYFRAMES], axis=1).max()
        assert error < 1e-6, f"window {row} is {1e3 * error:.3g} mm off"


@pytest.mark.long
def test_the_gradient_through_five_windows_is_the_finite_difference() -> None:
    # Proves reverse mode through five windows that were solved, marginalised and slid in a `scan`, of two sequences:
    # the last window's new pose by the matches' weights of the first. Oracle: central differences of fourth order. A
    # keyframe that the first window hardly sees, and absent matches, are part of it.
    solver = SchurLevenbergMarquardt(rtol=1e-12)

    def loss(weight: jax.Array, windows: Windows) -> jax.Array:
        first, start = pick(windows, 0)
        states = slid(first.with_term(first.terms["points"].reweighted(weight)), start, rolled(windows), solver)
        return jnp.sum(jnp.sin(3 * states.poses.wxyz_xyz[-1, -1]))

    evaluate, rng = jax.jit(jax.value_and_grad(loss)), np.random.default_rng(0)
    for share in (0.0, 0.05):
        windows = stacked(long_window(lines=0, outliers=share))
        first, _ = pick(windows, 0)
        apart = (first.edges.target == 1)[:, None] & (jnp.arange(first.terms["points"].weight.shape[-1]) > 0)
        weight = jnp.where(apart, 0.0, first.terms["points"].weight)
        along = jnp.asarray(rng.normal(size=weight.shape)) * (weight > 0)
        gradient = evaluate(weight, windows)[1]
        change = lambda size, w=weight, a=along, s=windows: evaluate(w + size * a, s)[0] - evaluate(w - size * a, s)[0]
        expected = float(8 * change(1e-3) - change(2e-3)) / 12e-3
        assert float(jnp.sum(gradient * along)) == pytest.approx(expected, rel=1e-6)
        assert float(jnp.abs(jnp.where(weight > 0, 0.0, gradient)).max()) == 0.0
