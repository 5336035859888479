"""Packing flat lists into padded arrays and back: nothing is lost or invented, wrong lists are refused."""

import inspect
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from reported import raises
from scenes import Scene, make_scene
from vggtgeo.solvers.schur_complement import Reduced, dense_schur_complement

import vggtgeo as vg
from vggtgeo.bundle.linearise import linearise
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.simulation import simulate_window

SCENE = make_scene(noise=0.5, outliers=0.2, depth_error=0.05)


UNCHECKED = inspect.unwrap(pack)
"""As a user calls it: in the tests a check of types comes before the words that are proved here."""


@pytest.mark.parametrize("double", [False, True])
def test_the_precision_is_that_of_jax_unless_it_is_given(double: bool) -> None:
    """A user who did not turn on `jax_enable_x64` gets single precision without a warning; oracle: JAX's own type, and
    the warnings, which are errors here.
    """
    window = simulate_window(keyframes=3, points=4, lines=1)
    with jax.enable_x64(double):
        problem, initial, _ = window.pack()
        expected = jnp.ones(()).dtype
    leaves = [leaf for leaf in jax.tree.leaves((problem, initial)) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert {leaf.dtype for leaf in leaves} == {expected}
    assert {leaf.dtype for leaf in jax.tree.leaves(window.pack(dtype=np.float32)[1])} == {np.dtype(np.float32)}


def observed(problem: Problem) -> set[tuple[float, ...]]:
    """Every point observation as (host pixel, match, weight, host, target): what there is, whatever its place."""
    edge, slot = np.nonzero(problem.terms["points"].weight > 0)
    source, target = np.asarray(problem.edges.source)[edge], np.asarray(problem.edges.target)[edge]
    points = problem.terms["points"]
    rows = [problem.pixels[source, slot], points.target[edge, slot], points.weight[edge, slot][:, None]]
    return {
        (*map(float, row), int(i), int(j)) for row, i, j in zip(np.concatenate(rows, 1), source, target, strict=True)
    }


@pytest.mark.parametrize(
    "size", [None, PaddedSize(4, 8, 6, 3), PaddedSize(3, 6, 3, 2), PaddedSize(4, 8, 6, 3, edges=8)]
)
def test_every_observation_is_packed_once(size: PaddedSize | None) -> None:
    # Proves that packing keeps each match with its pixel, edge and weight. Oracle: the flat lists.
    seen = SCENE.observations
    problem, _, _ = SCENE.pack(size=size)
    edges = seen.edges[seen.point_edge]
    rows = [seen.pixel[seen.point_landmark], seen.point_target, seen.point_weight[:, None]]
    expected = {(*map(float, row), int(i), int(j)) for row, (i, j) in zip(np.concatenate(rows, 1), edges, strict=True)}
    assert observed(problem) == expected
    assert int(jnp.sum(problem.terms["lines"].weight > 0)) == len(seen.line_edge)
    assert float(jnp.sum(problem.terms["depth"].weight)) == pytest.approx(seen.depth_weight.sum())


def test_padding_is_harmless_and_held() -> None:
    # Proves what fills the empty places: weight 0, finite values, positive depths, poses that are held.
    problem, state, _ = SCENE.pack(size=PaddedSize(5, 8, 6, 4))
    assert bool(jnp.all(problem.fixed_pose[3:]))
    assert list(problem.fixed_pose[:3]) == [True, False, False]
    assert bool(jnp.all(state.inverse_depth > 0))
    assert bool(jnp.all(problem.terms["depth"].sigma > 0))
    np.testing.assert_array_equal(jnp.linalg.norm(state.poses.wxyz_xyz[:, :4], axis=1).round(12), 1.0)


@jax.jit  # of single operations, every one would be compiled by itself
def eliminated(problem: Problem, state: State) -> Reduced:
    """Normal equations without landmarks."""
    return dense_schur_complement(linearise(prepared(problem), state))


@pytest.mark.parametrize("edges", [6, 7, 12])
def test_padding_edges_change_nothing(edges: int) -> None:
    # Proves that stored edges beyond those of the problem leave its normal equations. Oracle: every row padded.
    systems = []
    for stored in (None, edges):
        problem, state, _ = SCENE.pack(size=PaddedSize(4, 8, 6, 3, edges=stored))
        assert len(problem.edges.source) == (stored or 12)
        systems.append(eliminated(problem, state))
    for name in ("hessian", "gradient", "schur", "schur_gradient"):
        every, some = (np.asarray(getattr(system, name)) for system in systems)
        np.testing.assert_allclose(some, every, rtol=1e-10, atol=1e-10 * np.abs(every).max(), err_msg=name)


def test_dtype_goes_through_everything() -> None:
    # Proves that one argument decides the precision of the whole problem, numbers of a kernel that were given as Python
    # has them too: a problem that was read from a file is no other type, and nothing is compiled twice.
    problem, state, _ = SCENE.pack(dtype=np.float32, kernel=vg.kernels.Huber(1.5))
    arrays = [leaf for leaf in jax.tree.leaves((problem, state)) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert {array.dtype for array in arrays} == {np.dtype(np.float32)}
    assert not any(array.weak_type for array in arrays)


def bad(**changes: object) -> Scene:
    return SCENE.with_observations(**changes)


def test_wrong_lists_are_refused_by_name() -> None:
    # Proves that each mistake is named with the argument, what was found, and what is right.
    seen = SCENE.observations
    both_kinds, its_edge = seen.line_landmark.copy(), seen.line_edge.copy()
    both_kinds[0], its_edge[0] = seen.point_landmark[0], seen.point_edge[0]
    twice = seen.point_landmark.copy()
    twice[1] = twice[0]
    wrong_host = seen.point_edge.copy()
    wrong_host[0] = len(seen.edges) - 1
    cases = [
        (bad(edges=seen.edges + 1), ("`edges`", 1, 3)),
        (bad(host=seen.host - 1), ("`host`", -1)),
        (bad(point_edge=seen.point_edge + 9), ("`point_edge`", 9)),
        (bad(line_landmark=seen.line_landmark + 1000), ("`line_landmark`",)),
        (bad(edges=seen.edges + 0.5), ("`edges`", "float64")),
        (replace(SCENE, start_poses=np.nan * SCENE.start_poses), ("`poses[0]`", "finite", "nan")),
        (bad(point_edge=wrong_host), ("`point_edge[0]`", "hosts", len(seen.edges) - 1)),
        (bad(line_landmark=both_kinds, line_edge=its_edge), ("`point_landmark`", "`line_landmark`")),
        (bad(point_landmark=twice), ("`point_edge` and `point_landmark[1]`", "distinct", 0)),
        (replace(SCENE, start_intrinsics=np.array([300.0, -1.0, 0.0, 0.0])), ("`intrinsics`", "positive", "-1")),
        (replace(SCENE, start_poses=2 * SCENE.start_poses), ("`poses[0]`", "quaternion", 2)),
        (bad(point_weight=seen.point_weight[1:]), ("`point_weight`", "shape")),
        (replace(SCENE, start_poses=SCENE.start_poses[:, :4]), ("`poses`", "(3, 4)", "(n, 7)")),
        (bad(point_weight=-seen.point_weight), ("`point_weight[0]`", "got -")),
        (bad(line_weight=seen.line_weight * np.nan), ("`line_weight[0]`", "nan")),
        (bad(alpha=-1.0), ("`alpha`", -1.0)),
        (bad(depth_mean=-seen.depth_mean), ("`depth_mean[0]`", "got -")),
        (bad(line_coefficients=3 * seen.line_coefficients), ("`line_coefficients[0]`", "normalised")),
        (bad(depth_sigma=0 * seen.depth_sigma), ("`depth_sigma[0]`", "got 0")),
        (replace(SCENE, start_inverse_depth=-SCENE.start_inverse_depth), ("`inverse_depth[0]`", "got -")),
        (replace(SCENE, start_inverse_depth=SCENE.start_inverse_depth[1:]), ("`inverse_depth`", "shape")),
    ]
    for scene, named in cases:
        with raises(*named):
            scene.pack()
    for options, named in (
        ({"model": vg.cameras.RadialTangential}, ("`intrinsics`", "(8)", "(4,)")),
        ({"shared_focal": True}, ("`intrinsics`", "(3)", "(4,)")),
        ({"camera_of": np.zeros(3, int)}, ("`intrinsics`", "(g, 4)")),
        ({"prior_mean": SCENE.start_intrinsics[:3]}, ("`prior_mean`", 4)),
        ({"prior_sigma": 0.0}, ("`prior_sigma`", "positive")),
        ({"fixed": np.ones(3, bool)}, ("`fixed`", 4)),
    ):
        with raises(*named):
            SCENE.pack(**options)


def test_lists_and_poses_are_taken_as_they_come() -> None:
    # Proves that lists and `jaxlie.SE3` pack as arrays do. Oracle: the arrays.
    expected, state, _ = SCENE.pack()
    seen = SCENE.observations
    start = (jaxlie.SE3(jnp.asarray(SCENE.start_poses)), list(SCENE.start_intrinsics), SCENE.start_inverse_depth)
    problem, same, _ = UNCHECKED(seen, *start)
    assert bool(jnp.all(problem.terms["points"].target == expected.terms["points"].target))
    assert bool(jnp.all(same.poses.wxyz_xyz == state.poses.wxyz_xyz))


def test_a_problem_in_which_nothing_is_observed_is_refused() -> None:
    # Proves that all weights zero are named by `pack` and by `solve` of arrays, that a prior on the camera alone or one
    # that says nothing does not count, and that a traced solve stays where it starts. Oracle: the message; the start.
    seen = SCENE.observations
    zero = {name: 0 * getattr(seen, name) for name in ("point_weight", "line_weight", "depth_weight")}
    start = SCENE.start_poses, SCENE.start_intrinsics, SCENE.start_inverse_depth
    held = start[0], vg.cameras.Intrinsics(SCENE.start_intrinsics, prior_sigma=5.0), start[2]
    for given, options in ((held, {}), (start, {"terms": [vg.empty_prior(3)]})):
        with raises("`problem`", "weights"):
            pack(replace(seen, **zero), *given, **options)
    problem, state, _ = SCENE.pack()
    nothing = problem.with_terms(tuple(term.reweighted(jnp.zeros_like(term.weight)) for term in problem.terms))
    with raises("`problem`", "weights"):
        vg.solve(nothing, state)
    solution = jax.jit(vg.solve)(nothing, state)
    assert float(jnp.abs(solution.state.poses.wxyz_xyz - state.poses.wxyz_xyz).max()) == 0.0
    fix = vg.terms.BaselinePrior(first=[0], second=[1], length=jnp.ones(1), sigma=jnp.ones(1), weight=jnp.ones(1))
    assert float(vg.energy(pack(replace(seen, **zero), *start, terms=[fix])[0], state)) > 0


class Packed(NamedTuple):
    """A window of unequal hosts in room for more, packed, and without any weight."""

    seen: vg.Observations
    problem: vg.Problem
    initial: vg.State
    index: vg.SlotIndex
    empty: vg.Problem


def random_order(seen: vg.Observations, seed: int) -> vg.Observations:
    """The same matches and samples in another order, some of them left out."""
    rng = np.random.default_rng(seed)
    points, lines = (rng.permutation(len(given))[:-7] for given in (seen.point_edge, seen.line_edge))
    fields = {name: getattr(seen, name)[points] for name in vars(seen) if name.startswith("point_")}
    fields |= {name: getattr(seen, name)[lines] for name in vars(seen) if name.startswith("line_")}
    fields["point_weight"] = rng.uniform(0.5, 2.0, len(points))
    fields["line_weight"] = rng.uniform(0.5, 2.0, len(lines))
    return replace(seen, **fields, depth_weight=rng.uniform(0.5, 2.0, len(seen.host)))


@pytest.fixture(scope="module", params=[None, vg.PaddedSize(6, 15, 12, 5)], ids=["smallest", "padded"])
def packed(request: pytest.FixtureRequest) -> Packed:
    window = vg.simulate_window(4, points=10, lines=2)
    window = replace(window, observations=random_order(window.observations, 1))
    problem, initial, index = window.pack(size=request.param)
    nothing = [term.reweighted(jnp.zeros_like(term.weight)) for term in problem.terms]
    return Packed(window.observations, problem, initial, index, problem.with_terms(tuple(nothing)))


def test_scattered_weights_are_those_that_pack_places(packed: Packed) -> None:
    """Weights of points, lines and depths written into arrays of zeros under `jit` are those of `pack`, and vectors
    are, too. Oracle: `pack`, which places them in numpy.
    """
    seen, problem, initial, index, empty = packed

    @jax.jit
    def weights(points: jax.Array, lines: jax.Array, depths: jax.Array) -> tuple[jax.Array, ...]:
        return (
            index.scatter_points(points, seen, empty.terms["points"].weight),
            index.scatter_lines(lines, seen, empty.terms["lines"].weight),
            index.scatter(depths, empty.terms["depth"].weight),
        )

    found = weights(*map(jnp.asarray, (seen.point_weight, seen.line_weight, seen.depth_weight)))
    for array, term in zip(found, problem.terms.ordered[:3], strict=True):
        np.testing.assert_array_equal(array, term.weight)
    target = index.scatter_points(seen.point_target, seen, jnp.ones_like(problem.terms["points"].target))
    np.testing.assert_array_equal(target, problem.terms["points"].target)
    back = index.gather(index.scatter(np.arange(len(seen.host)), initial.inverse_depth))
    np.testing.assert_array_equal(back, np.arange(len(seen.host)))


def test_the_gradient_by_flat_weights_is_that_by_the_padded_ones(packed: Packed) -> None:
    """The derivative of the energy by one number a match is that by the padded weight at its place. Oracle: the
    derivative by `problem.terms["points"].weight`, read by `gather_points`.
    """
    seen, problem, initial, index, _ = packed
    energy = lambda weight: vg.energy(problem.with_term(problem.terms["points"].reweighted(weight)), initial)
    flat = lambda values: energy(index.scatter_points(values, seen, problem.terms["points"].weight))
    found = jax.jit(jax.grad(flat))(jnp.asarray(seen.point_weight))
    expected = index.gather_points(jax.jit(jax.grad(energy))(problem.terms["points"].weight), seen)
    assert float(np.abs(expected).max()) > 0
    np.testing.assert_allclose(found, expected, rtol=1e-12)
