"""Random graphs of keyframes, cut and whole: each connected component that is solved is held at exactly one place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vggtgeo.solvers.schur_complement import dense_schur_complement

from vggtgeo.bundle.linearise import free_coordinates, linearise
from vggtgeo.bundle.marginalisation import empty_prior, marginalise_jit
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import solve
from vggtgeo.bundle.terms.measured_pose import RelativePose
from vggtgeo.geometry import rigid
from vggtgeo.simulation.small_window import SimulatedWindow, simulate_window
from vggtgeo.slam.settings.groups import WindowSettings
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.window.gauge import gauge_notes, with_one_gauge
from vggtgeo.slam.window.sliding_window import Window, WindowPrior, marginalise_oldest

KEYFRAMES, POINTS = 7, 12
SOLVE = eqx.filter_jit(solve)


@eqx.filter_jit
def _information(problem: Problem, state: State) -> tuple[jnp.ndarray, jnp.ndarray]:
    """Of the poses, landmarks eliminated; and which coordinates are free."""
    reduced = dense_schur_complement(linearise(prepared(problem), state))
    return reduced.hessian - reduced.schur, free_coordinates(problem)


def _null_dimensions(problem: Problem, state: State) -> int:
    """Directions of the free poses that nothing determines, by the eigenvalues of the balanced information."""
    information, free = (np.array(array) for array in _information(problem, state))
    free[-problem.num_parameters :] = False
    own = information[np.ix_(free, free)]
    scale = np.sqrt(np.maximum(np.diag(own), 0.0))
    balanced = own / np.outer(np.where(scale > 0, scale, 1.0), np.where(scale > 0, scale, 1.0))
    return int(np.count_nonzero(np.linalg.eigvalsh(balanced) < 1e-9))


def _random_graph(seed: int, few: int = 1) -> tuple[SimulatedWindow, Problem, State]:
    """Exact observations of which each pair of keyframes keeps none, `few` or all, in a random graph with cut edges,
    some motions that are known without a match, and any poses held: none, one, or several.
    """
    rng = np.random.default_rng(seed)
    window = simulate_window(KEYFRAMES, POINTS, 0, noise=0.0, depth_error=0.0, start_error=0.02, seed=seed)
    seen, part = window.observations, rng.integers(0, rng.integers(1, 4), KEYFRAMES)
    kept = {}
    for pair in combinations(range(KEYFRAMES), 2):
        across = part[pair[0]] != part[pair[1]]
        kept[pair] = 0 if across else int(rng.choice([0, 0, few, POINTS]))
    ends = np.sort(seen.edges[seen.point_edge], 1)
    here = np.array([seen.point_landmark[k] % POINTS < kept[tuple(ends[k])] for k in range(len(ends))])
    ends = np.array([rng.permutation(KEYFRAMES)[:2] for _ in range(2)])
    ties = _ties(window, ends, (rng.random(2) < 0.5).astype(float))
    fixed = np.isin(np.arange(KEYFRAMES), rng.permutation(KEYFRAMES)[: rng.integers(0, 4)])
    observed = replace(window, observations=replace(seen, point_weight=here.astype(float)))
    problem, initial, _ = observed.pack(terms=(empty_prior(KEYFRAMES), ties), fixed_pose=fixed)
    return observed, problem, initial


def _ties(window: SimulatedWindow, ends: np.ndarray, weight: np.ndarray) -> RelativePose:
    """The true motions between two pairs of keyframes."""
    poses, (first, second) = rigid.to_matrix(window.poses), ends.T
    motion = poses[second] @ rigid.invert(poses[first])
    return RelativePose(
        first=first,
        second=second,
        measured=jnp.asarray(rigid.to_quaternion(motion)),
        root=jnp.tile(100.0 * jnp.eye(6), (2, 1, 1)),
        weight=jnp.asarray(weight),
    )


def _off(window: SimulatedWindow, state: State, components: Iterable[Iterable[int]]) -> float:
    """Largest error of a relative pose between keyframes of one component, metres or radians."""
    true, found = rigid.to_matrix(window.poses), rigid.to_matrix(np.asarray(state.poses.wxyz_xyz)[: len(window.poses)])
    worst = 0.0
    for component in components:
        for a, b in combinations(component, 2):
            error = found[b] @ rigid.invert(found[a]) @ rigid.invert(true[b] @ rigid.invert(true[a]))
            turned = np.linalg.norm(Rotation.from_matrix(error[:3, :3]).as_rotvec())
            worst = max(worst, float(np.linalg.norm(error[:3, 3])), float(turned))
    return worst


@pytest.mark.parametrize("seed", range(24))
def test_each_component_of_a_random_graph_has_one_gauge(seed: int) -> None:
    """Nothing is free, each component given free has exactly six free directions, and each is solved right.

    Oracle: eigenvalues of the dense information of all poses; the true relative poses within each component. Every
    other graph has links too weak to tie.
    """
    few = 1 + 2 * (seed % 2)
    window, problem, initial = _random_graph(seed, few)
    held, gauge = with_one_gauge(problem, initial, KEYFRAMES, metric=True)
    assert sorted(row for component in gauge.components for row in component) == list(range(KEYFRAMES))
    fixed = np.asarray(held.fixed_pose)
    assert [int(fixed[list(component)].sum()) for component in gauge.components] == [1] * len(gauge.components)
    assert _null_dimensions(held, initial) == 0
    free = replace(held, fixed_pose=jnp.zeros(KEYFRAMES, bool))
    assert _null_dimensions(free, initial) == 6 * len(gauge.components)
    for component in gauge.free:
        assert not np.asarray(problem.fixed_pose)[list(component)].any()
    solution = SOLVE(held, initial)
    assert np.isfinite(np.asarray(solution.state.poses.wxyz_xyz)).all()
    error = _off(window, solution.state, gauge.components)
    assert error < 1e-4, f"{gauge.components}: {error:.2e}"


def test_what_is_held_is_said() -> None:
    """A keyframe without any match is named in a note, and stays where it was; oracle: the graph as it was cut."""
    window = simulate_window(KEYFRAMES, POINTS, 0, noise=0.0, depth_error=0.0, start_error=0.02)
    problem, initial, _ = window.pack(terms=(empty_prior(KEYFRAMES), _ties(window, np.zeros((2, 2), int), np.zeros(2))))
    apart = np.asarray(problem.edges.source)[:, None] == 3
    apart = apart | (np.asarray(problem.edges.target)[:, None] == 3)
    cut = problem.with_term(problem.terms["points"].reweighted(jnp.where(apart, 0.0, problem.terms["points"].weight)))
    cut = replace(cut, fixed_pose=jnp.asarray(np.arange(KEYFRAMES) == 0))
    held, gauge = with_one_gauge(cut, initial, KEYFRAMES, metric=True)
    assert gauge.free == ((3,),)
    notes = gauge_notes(gauge, tuple(range(10, 10 + KEYFRAMES)), "window")
    assert len(notes) == 1
    assert "keyframes 13 " in notes[0]
    solution = SOLVE(held, initial)
    np.testing.assert_array_equal(solution.state.poses.wxyz_xyz[3], initial.poses.wxyz_xyz[3])
    assert _off(window, solution.state, gauge.components) < 1e-4


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_windows_whose_first_keyframe_leaves_keep_their_gauge(seed: int) -> None:
    """A window slides over a random chain; what left holds the rest by its prior, and what it did not know is held.

    Oracle: the true relative poses within each component, and eigenvalues of the dense information.
    """
    window, problem, state = _random_graph(100 + seed, few=3)
    numbers: tuple[int, ...] = tuple(range(KEYFRAMES))
    problem, first = with_one_gauge(problem, state, KEYFRAMES, metric=True)
    state = SOLVE(problem, state).state
    for leaving in range(3):
        prior = WindowPrior(numbers, marginalise_jit(problem, state, jnp.asarray(leaving)))
        staying = np.arange(KEYFRAMES) > leaving
        gone = ~staying[np.asarray(problem.edges.source)] | ~staying[np.asarray(problem.edges.target)]
        problem = problem.with_term(problem.terms["points"].reweighted(problem.terms["points"].weight * ~gone[:, None]))
        depth = problem.terms["depth"]
        problem = problem.with_term(depth.reweighted(depth.weight * staying[:, None]))
        ties = problem.terms["relative_poses"]
        inside = staying[np.asarray(ties.first)] & staying[np.asarray(ties.second)]
        problem = problem.with_term(ties.reweighted(ties.weight * inside), replace=True)
        order = tuple(number if staying[number] else -1 for number in range(KEYFRAMES))
        problem = problem.with_term(prior.aligned(order, KEYFRAMES))
        # Those that left are no part of the problem any more: they are held as padding is.
        problem = replace(problem, fixed_pose=jnp.asarray(np.where(staying, np.asarray(problem.fixed_pose), True)))
        problem, gauge = with_one_gauge(problem, state, KEYFRAMES, metric=True)
        assert _null_dimensions(problem, state) == 0, gauge
        shaken = np.array(state.poses.wxyz_xyz)
        free = ~np.asarray(problem.fixed_pose)
        shaken[free, 4:] += np.random.default_rng(seed).normal(0, 0.01, (free.sum(), 3))
        moved = eqx.tree_at(lambda s: s.poses.wxyz_xyz, state, jnp.asarray(shaken))
        solution = SOLVE(problem, moved)
        state = solution.state
        # Two components that were held apart at first stay so: the prior keeps both where they were.
        error = _off(window, state, [[row for row in component if row > leaving] for component in first.components])
        assert error < 1e-3, f"{first.components} without {leaving}: {error:.2e}"


def test_a_unit_that_nothing_tells_is_held() -> None:
    """Without any depth the size of a component is held by a second keyframe; oracle: the dense information's rank."""
    window = simulate_window(KEYFRAMES, POINTS, 0, noise=0.0, depth_error=0.0, start_error=0.0)
    seen = replace(window.observations, depth_weight=np.zeros(KEYFRAMES * POINTS))
    bare = replace(window, observations=seen)
    problem, initial, _ = bare.pack(terms=(empty_prior(KEYFRAMES),))
    assert _null_dimensions(problem, initial) == 1
    held, gauge = with_one_gauge(problem, initial, KEYFRAMES, metric=False)
    assert gauge.loose == (tuple(range(KEYFRAMES)),)
    assert _null_dimensions(held, initial) == 0


def test_the_keyframe_that_the_next_is_tied_to_stays() -> None:
    """Of a full window the oldest leaves, but not the one that the next keyframe hangs on: without it nothing might tie
    the next. Oracle: the numbers.
    """
    settings = SlamSettings(window=WindowSettings(size=4, point_slots=16, line_slots=12))
    window = Window(members=(3, 4, 5, 6))
    assert marginalise_oldest(window, settings).members == (4, 5, 6)
    assert marginalise_oldest(window, settings, needed=3).members == (3, 5, 6)
    assert marginalise_oldest(window, settings, needed=5).members == (4, 5, 6)
    assert marginalise_oldest(Window(members=(4, 5, 6)), settings, needed=4).members == (4, 5, 6)
