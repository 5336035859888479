"""Keyframes that host many landmarks have several rows of them: nothing but the layout may depend on that."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import make_scene
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import ConjugateGradients
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

import vggtgeo as vg
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State

SCENE = make_scene(seed=3, keyframes=3, points=12, lines=3, samples=4, noise=0.5)
SPLIT = PaddedSize(4, 5, 4, 3, rows=11)
"""Three rows for each of three keyframes, one for a keyframe that pads, and a spare one."""


class NotNear(vg.terms.SlotTerm):
    """A landmark term of a user."""

    nearest: jax.Array

    def residual(self, inverse_depth: jax.Array) -> jax.Array:
        return inverse_depth - self.nearest


class Distance(vg.terms.EdgeTerm):
    """An edge term of a user."""

    known: jax.Array

    def residual(self, view: vg.terms.View) -> jax.Array:
        return view.point[2] - self.known


def packed(size: PaddedSize | None) -> tuple[Problem, State, Any]:
    """The scene, with terms of a user on landmarks and edges."""
    seen = SCENE.observations
    landmark = np.arange(len(seen.host))[::-3].copy()
    near = vg.terms.FlatTerm(NotNear, {"nearest": 0.3 + 0.01 * landmark, "weight": 1.0 + landmark}, landmark)
    pairs = seen.point_edge[::2], seen.point_landmark[::2]
    far = vg.terms.FlatTerm(Distance, {"known": 3.0 + 0.1 * np.arange(len(pairs[0]))}, pairs[1], pairs[0])
    return SCENE.pack(size=size, terms=[near, far])


WHOLE, ROWS = packed(PaddedSize(4, 12, 12, 3)), packed(SPLIT)
SOLVER = SchurLevenbergMarquardt(max_iterations=30)


@jax.jit
def solved(problem: Problem, start: State) -> vg.Solution:
    return vg.solve(problem, start, solver=SOLVER)


@pytest.fixture(scope="module")
def solutions() -> tuple[vg.Solution, vg.Solution]:
    return solved(*WHOLE[:2]), solved(*ROWS[:2])


def test_the_solution_does_not_depend_on_the_rows(solutions: tuple[vg.Solution, vg.Solution]) -> None:
    # Proves that terms, energy and steps are the same with several rows a host. Oracle: the problem with one.
    assert ROWS[0].pixels.shape[0] == 11
    assert WHOLE[0].host is None
    whole, rows = solutions
    assert bool(whole.converged)
    assert float(whole.energy) < 0.6 * float(whole.history[0])
    np.testing.assert_allclose(rows.history, whole.history, rtol=1e-9)
    for name, value in vg.analysis.energy_terms(WHOLE[0], WHOLE[1]).items():
        assert float(vg.analysis.energy_terms(ROWS[0], ROWS[1])[name]) == pytest.approx(float(value), rel=1e-12), name
    np.testing.assert_allclose(rows.state.poses.wxyz_xyz, whole.state.poses.wxyz_xyz, atol=1e-9)
    gathered = [index.gather(s.state.inverse_depth) for (_, _, index), s in zip((WHOLE, ROWS), solutions, strict=True)]
    np.testing.assert_allclose(gathered[1], gathered[0], rtol=1e-8)


def test_matches_are_found_again() -> None:
    # Proves that `gather_points` finds each match in an edge of its landmark's row. Oracle: the observations.
    seen = SCENE.observations
    for problem, _, index in (WHOLE, ROWS):
        target = index.gather_points(problem.terms["points"].target, seen)
        np.testing.assert_allclose(target, seen.point_target, rtol=1e-12)
        ends = np.stack([problem.edges.source, problem.edges.target], 1)
        np.testing.assert_array_equal(
            ends[index.stored_edge(seen.point_edge, seen.point_landmark)], seen.edges[seen.point_edge]
        )
        np.testing.assert_allclose(index.gather(problem.pixels), seen.pixel, rtol=1e-12)


@pytest.fixture(scope="module")
def known(solutions: tuple[vg.Solution, vg.Solution]) -> tuple[vg.analysis.Covariances, vg.analysis.Covariances]:
    """By the dense solver."""
    return vg.covariances(WHOLE[0], solutions[0].state), vg.covariances(ROWS[0], solutions[1].state)


def test_covariances_and_observability_do_not_depend_on_the_rows(solutions: Any, known: Any) -> None:
    # Proves that what is known is the same, of some keyframes, too. Oracle: the problem with one row a host.
    whole, rows = known
    np.testing.assert_allclose(rows.poses, whole.poses, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(rows.intrinsics, whole.intrinsics, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(ROWS[2].gather(rows.inverse_depth), WHOLE[2].gather(whole.inverse_depth), rtol=1e-6)
    assert float(rows.variance_factor) == pytest.approx(float(whole.variance_factor), rel=1e-8)
    some = vg.covariances(ROWS[0], solutions[1].state, keyframes=[2, 1])
    np.testing.assert_allclose(some.poses, whole.poses[jnp.array([2, 1])], rtol=1e-6)
    assert len(some.inverse_depth) == int(np.isin(np.asarray(ROWS[0].host), [1, 2]).sum())
    spectra = [vg.observability(p[0], s.state).whole.values for p, s in zip((WHOLE, ROWS), solutions, strict=True)]
    np.testing.assert_allclose(spectra[1], spectra[0], rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize("solver", [BandCholesky(3), ConjugateGradients()], ids=["band", "conjugate gradients"])
def test_every_linear_solver_takes_rows(solver: Any, solutions: tuple[vg.Solution, vg.Solution], known: Any) -> None:
    # Proves the step and the covariances of the other linear solvers. Oracle: the dense one.
    run = SchurLevenbergMarquardt(max_iterations=30, reduced_solver=solver)
    found = jax.jit(lambda problem, start: vg.solve(problem, start, solver=run))(*ROWS[:2])
    assert float(found.energy) == pytest.approx(float(solutions[0].energy), rel=1e-9)
    asked = vg.covariances(ROWS[0], solutions[1].state, reduced_solver=solver)
    np.testing.assert_allclose(asked.poses, known[1].poses, rtol=1e-4, atol=1e-10)
    np.testing.assert_allclose(asked.inverse_depth, known[1].inverse_depth, rtol=1e-4)


@pytest.mark.long
def test_derivatives_do_not_depend_on_the_rows() -> None:
    # Proves implicit differentiation and marginalisation with several rows. Oracles: central differences of fourth
    # order of the polished optimum, along a random direction; the prior of one row a host.
    problem, start, _ = ROWS

    def loss(target: jax.Array) -> jax.Array:
        centre = solved(problem.with_term(_with_target(problem, target)), start).state.poses.translation()[1]
        return jnp.sum(jnp.sin(3 * centre))

    evaluate, target = jax.jit(jax.value_and_grad(loss)), problem.terms["points"].target
    present = (np.asarray(problem.terms["points"].weight) > 0)[..., None]
    along = present * np.random.default_rng(0).normal(size=target.shape)
    change = lambda size: float(evaluate(target + size * along)[0] - evaluate(target - size * along)[0])
    gradient = np.asarray(evaluate(target)[1])
    assert np.sum(gradient * along) == pytest.approx((8 * change(1e-2) - change(2e-2)) / 12e-2, rel=1e-5)
    assert not gradient[~np.broadcast_to(present, gradient.shape)].any()
    priors = [jax.jit(vg.marginalise)(p.with_term(vg.empty_prior(4)), s, jnp.asarray(1)) for p, s, _ in (WHOLE, ROWS)]
    assert float(jnp.abs(priors[0].root).max()) > 1
    squared = [prior.root.T @ prior.root for prior in priors]
    np.testing.assert_allclose(squared[1], squared[0], rtol=1e-7, atol=1e-6 * float(jnp.abs(squared[0]).max()))


def _with_target(problem: Problem, target: jax.Array) -> vg.terms.PointTerm:
    points = problem.terms["points"]
    return vg.terms.PointTerm(target=target, weight=points.weight, kernel=points.kernel, first_slot=points.first_slot)


def test_pack_chooses_rows_by_itself() -> None:
    # Proves that `pack` and `pack_batch` split a rich host without being asked, and say what does not fit.
    rich = make_scene(seed=5, keyframes=3, points=60, lines=0, samples=1)
    seen = rich.observations
    some = np.isin(seen.host, [0]) | (np.arange(len(seen.host)) % 15 == 0)
    number = np.cumsum(some) - 1
    kept = some[seen.point_landmark]
    own = rich.with_observations(
        host=seen.host[some],
        pixel=seen.pixel[some],
        depth_mean=seen.depth_mean[some],
        depth_sigma=seen.depth_sigma[some],
        depth_weight=seen.depth_weight[some],
        point_edge=seen.point_edge[kept],
        point_landmark=number[seen.point_landmark[kept]],
        point_target=seen.point_target[kept],
        point_weight=seen.point_weight[kept],
    ).observations
    start = rich.start_poses, rich.start_intrinsics, rich.start_inverse_depth[some]
    problem, initial, index = vg.pack(own, *start)
    assert problem.host is not None
    assert len(problem.pixels) > problem.num_keyframes == 3
    assert initial.poses.wxyz_xyz.shape == (3, 7)
    np.testing.assert_allclose(index.gather(initial.inverse_depth), start[2], rtol=1e-12)
    whole = int(np.bincount(own.host).max())
    one, first, _ = vg.pack(own, *start, size=PaddedSize(3, whole, 0, 2))
    assert float(vg.energy(problem, initial)) == pytest.approx(float(vg.energy(one, first)), rel=1e-12)
    problems, initials, _ = vg.batches.pack_batch([(own, *start), (seen, *start[:2], rich.start_inverse_depth)])
    energies = jax.vmap(vg.energy)(problems, initials)
    assert float(energies[0]) == pytest.approx(float(vg.energy(one, first)), rel=1e-12)
    for size in (PaddedSize(3, 5, 0, 2, rows=4), PaddedSize(3, 0, 0, 2, rows=99), PaddedSize(3, 5, 0, 2)):
        with pytest.raises(vg.InputError, match="size"):
            vg.pack(own, *start, size=size)


def test_segments_stay_whole() -> None:
    # Proves that the samples of a two-ends line share a row, and the solution of a scene with them. Oracle: one row.
    made = make_scene(3, points=6, lines=3, samples=4, noise=0.5, depth_error=0.05, seed=5)
    scene = made.with_segments(4)
    whole = scene.pack(size=PaddedSize(3, 6, 12, 2, samples=4))
    rows = scene.pack(size=PaddedSize(3, 3, 4, 2, samples=4, rows=9))
    found = [solved(*packed[:2]) for packed in (whole, rows)]
    assert float(found[0].energy) < 0.5 * float(found[0].history[0])
    np.testing.assert_allclose(found[1].state.poses.wxyz_xyz, found[0].state.poses.wxyz_xyz, atol=1e-9)
    depths = [packed[2].gather(s.state.inverse_depth) for packed, s in zip((whole, rows), found, strict=True)]
    np.testing.assert_allclose(depths[1], depths[0], rtol=1e-8)
