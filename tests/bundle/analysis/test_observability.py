"""Observability: constructed problems whose weak direction is known, and the definition of the shares."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from degenerate_scenes import (
    HELD,
    KEYFRAMES,
    POINTS,
    WELL,
    one_plane,
    packed,
    parallel_lines,
    pure_rotation,
    random_points,
    random_segments,
    scene_of,
    without,
    without_matches_of,
)
from scenes import Scene
from scipy.spatial.transform import Rotation
from vggtgeo.solvers.arrow import ArrowVector

from vggtgeo.bundle.analysis.covariances import covariances
from vggtgeo.bundle.analysis.observability import observability
from vggtgeo.bundle.analysis.observability_report import (
    WEAK,
    Observability,
    least_known,
    rotation_pairs,
    undetermined_landmarks,
    weak_directions,
)
from vggtgeo.bundle.analysis.weak_directions import MOTIONS, common_directions, direction_names
from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.objective import energy
from vggtgeo.bundle.problem import Problem, State

KINDS = ("points", "lines", "depth", "intrinsics_prior")
Observe = Callable[[Problem, State], Observability]
LOST = [f"keyframe 2: {motion}" for motion in MOTIONS]
NO_PRIOR = {"prior_sigma": None}


@pytest.fixture(scope="module")
def observed() -> Observe:
    """`observability`, compiled once for all tests of this file."""
    return jax.jit(observability)


@pytest.mark.parametrize(
    ("scene", "options", "expected"),
    [
        (WELL, {}, []),
        (WELL, NO_PRIOR, []),
        (without(WELL, "depth"), {}, ["scale"]),
        (one_plane(), {}, ["scale"]),
        (parallel_lines(), {"fixed": HELD}, ["translation along x", "keyframe 1: translation along x"]),
        (without_matches_of(2), {}, LOST),
    ],
    ids=["all factors", "no prior", "no depth", "one plane", "parallel lines", "unmatched keyframe"],
)
def test_the_weak_direction_by_name(observed: Observe, scene: Scene, options: dict, expected: list[str]) -> None:
    # Proves that exactly what the construction leaves open is found, named and called undetermined.
    found = observed(*packed(scene, at_truth=True, **options))
    weak = weak_directions(found)
    assert [direction.name for direction in weak] == expected, found.report()
    assert not any(direction.determined for direction in weak)
    assert all(direction.alignment > 0.999 for direction in weak)
    values = np.asarray(found.whole.values[0])
    assert values[len(expected)] > 10 * WEAK, values


def test_no_parallax(observed: Observe) -> None:
    # Proves that under pure rotation every inverse depth is undetermined, which its short form says, and none in the
    # well-posed problem.
    found = observed(*packed(pure_rotation(), at_truth=True))
    turning = undetermined_landmarks(found)
    assert f"{turning[0]} of {turning[1]} inverse depths undetermined" in repr(found)
    assert turning == (KEYFRAMES * POINTS, KEYFRAMES * POINTS)
    lost, used = undetermined_landmarks(observed(*packed(WELL, at_truth=True)))
    assert (lost, used) == (0, WELL.observations.host.size)


def forward_motion(turn: float) -> Scene:
    """Three cameras that drive straight ahead, turned by some `turn` radians each, points only."""
    rotation = Rotation.from_rotvec(turn * np.random.default_rng(0).normal(size=(KEYFRAMES, 3)))
    shift = -rotation.apply(np.outer(0.25 * np.arange(KEYFRAMES), [0.0, 0.0, 1.0]))
    poses = np.concatenate([rotation.as_quat(scalar_first=True), shift], 1)
    return without(scene_of(poses, *random_points(), random_segments()), "line", "depth")


CENTRE_HELD = {"fixed": np.array([False, False, True, True])}


def test_forward_motion_with_a_free_camera_by_name(observed: Observe) -> None:
    """Driving straight ahead, turned by milliradians, the least known direction is named and not hidden by the level of
    weak ones: the focal length, by more than its own value. Oracle: the construction; the dense inverse, which
    `covariances` is tested against.
    """
    problem, state = packed(forward_motion(0.003), at_truth=True, **NO_PRIOR, **CENTRE_HELD)
    found = observed(problem, state)
    assert [direction.name for direction in weak_directions(found)] == ["scale"]
    first = least_known(found)[0]
    assert first.names[0] == "focal length"
    assert first.parameters["fx"] > 300
    assert first.parameters["fx"] == pytest.approx(float(covariances(problem, state).intrinsics[0, 0]) ** 0.5, rel=0.05)
    assert f"least known: {first}" in str(found)
    assert found.to_dict()["least_known"][0]["sigma"]["fx"] == first.parameters["fx"]


def test_a_lens_that_nothing_determines_is_undetermined(observed: Observe) -> None:
    """Without any turn the focal length has no part in a match: `u / (1 - d t)`. So it is undetermined, by name, and no
    direction is said to have a standard deviation along it. Oracle: the construction.
    """
    found = observed(*packed(forward_motion(0.0), at_truth=True, **NO_PRIOR, **CENTRE_HELD))
    weak = weak_directions(found)
    assert {direction.name for direction in weak} == {"scale", "focal length", "aspect ratio"}
    assert not any(direction.determined for direction in weak)
    assert all(not direction.parameters for direction in least_known(found))


def test_one_sigma_of_the_least_known_direction(observed: Observe) -> None:
    """One standard deviation along it raises the energy by 1/2 when the depths follow, by as much as is said. Oracle:
    the Hessian of the energy by all coordinates together.
    """
    problem, state = packed(WELL, at_truth=True, **NO_PRIOR)
    found = observed(problem, state)
    first, dense = least_known(found)[0], 6 * KEYFRAMES + 4
    zero = jnp.zeros(dense + state.inverse_depth.size)
    hessian = np.asarray(jax.jit(jax.hessian(lambda step: energy(problem, state.moved(step))))(zero))
    step = np.where(found.free, found.whole.vectors[0, :, 0] / found.scale, 0.0) / np.sqrt(first.eigenvalue)
    depths = -np.linalg.solve(hessian[dense:, dense:], hessian[dense:, :dense] @ step)
    whole = np.concatenate([step, depths])
    assert whole @ hessian @ whole / 2 == pytest.approx(0.5, rel=1e-6)
    relative = depths / np.asarray(state.inverse_depth).ravel()
    assert first.depth == pytest.approx(np.sqrt(np.mean(relative**2)), rel=1e-6)
    assert first.parameters["fx"] == pytest.approx(abs(step[dense - 4]), rel=1e-9)


def test_pure_rotation_by_name(observed: Observe) -> None:
    """Keyframes between which the camera only turned are named, and no others. Oracle: the construction, with one of
    three cameras set aside by 30 cm, and the well-posed scene.
    """
    turned = pure_rotation()
    found = observed(*packed(turned, at_truth=True))
    assert rotation_pairs(found) == [(0, 1), (0, 2), (1, 2)]
    assert "pure rotation" in repr(found)
    assert "pure rotation between keyframes: 0 and 1; 0 and 2; 1 and 2" in str(found)
    poses = turned.poses.copy()
    poses[2, 4:] = [0.3, 0.0, 0.0]
    moved = without(scene_of(poses, *random_points(), random_segments()), "line", "depth")
    assert rotation_pairs(observed(*packed(moved, at_truth=True))) == [(0, 1)]
    assert observed(*packed(WELL, at_truth=True)).to_dict()["pure_rotation"] == []


def test_what_each_kind_is_worth(observed: Observe) -> None:
    # Proves that without the depth priors the scale goes, that they carry all of it, and that no other kind is needed
    # alone. Oracle: the problem is built so.
    found = observed(*packed(WELL, at_truth=True))
    assert [direction.name for direction in weak_directions(found, "depth")] == ["scale"]
    assert all(weak_directions(found, kind) == [] for kind in KINDS if kind != "depth")
    scale = direction_names(KEYFRAMES).index("scale")
    assert float(found.without.along[KINDS.index("depth"), scale]) < 1e-9 * float(found.whole.along[0, scale])
    assert float(found.alone.along[KINDS.index("depth"), scale]) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_kind_is_the_problem_without_it(observed: Observe, kind: str) -> None:
    # Proves the information of a selection, and that kinds never add up to more than the whole. Oracle: the whole of a
    # problem that never had the kind.
    problem, truth = packed(WELL, at_truth=True)
    weight = {
        "points": lambda p: p.terms["points"].weight,
        "lines": lambda p: p.terms["lines"].weight,
        "depth": lambda p: p.terms["depth"].weight,
        "intrinsics_prior": lambda p: p.terms["intrinsics_prior"].weight,
    }[kind]
    found = observed(problem, truth)
    lacking = observed(eqx.tree_at(weight, problem, replace_fn=jnp.zeros_like), truth)
    row, whole = KINDS.index(kind), np.asarray(found.whole.along[0])
    np.testing.assert_allclose(found.without.along[row], lacking.whole.along[0], rtol=1e-9, atol=1e-9 * whole.max())
    apart = np.asarray(found.without.along[row] + found.alone.along[row])
    assert np.all(apart <= whole + 1e-9 * whole.max())


@jax.jit
def moved_along_all(problem: Problem, state: State, step: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Camera centres and axes (in the world) and intrinsics after a small step along each named direction."""

    def moved(direction: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        vector = ArrowVector(step * direction, jnp.zeros_like(state.inverse_depth))
        new = BundleAdjustment(problem).retract(state, vector)
        back = new.poses.inverse()
        return back.translation(), back.rotation().as_matrix(), new.intrinsics

    single = jnp.eye(6 * KEYFRAMES, problem.num_camera)
    return jax.vmap(moved)(jnp.concatenate([common_directions(problem, state), single]))


def test_directions_are_the_motions_they_name() -> None:
    # Proves scale, common motions and focal length. Oracle: camera centres and axes moved by hand, first order.
    problem, state = packed(WELL, at_truth=True)
    names, step = direction_names(KEYFRAMES), 1e-6
    centres_of, axes_of, intrinsics_of = moved_along_all(problem, state, jnp.asarray(step))
    assert len(centres_of) == len(names)
    moved = {name: (centres_of[i], axes_of[i], intrinsics_of[i]) for i, name in enumerate(names)}
    back = state.poses.inverse()
    centres, axes = np.asarray(back.translation()), np.asarray(back.rotation().as_matrix())
    close = lambda found, expected: np.testing.assert_allclose(found, expected, atol=10 * step**2)
    close(moved["scale"][0] - centres, step * (centres - centres[0]))
    close(moved["scale"][1], axes)
    # A left tangent moves the world in the camera: the camera itself goes the other way.
    close(moved["translation along z"][0] - centres, np.broadcast_to(-step * axes[0][:, 2], centres.shape))
    turn = -step * np.cross(axes[0][:, 1], centres - centres[0])
    close(moved["yaw"][0] - centres, turn)
    close(moved["keyframe 1: roll"][0], centres)
    close(moved["keyframe 2: translation along x"][0][2] - centres[2], -step * axes[2][:, 0])
    close(moved["focal length"][2], np.asarray(state.intrinsics) * (1 + step * np.array([1, 1, 0, 0])))


def test_the_report_reads_well(observed: Observe) -> None:
    # Proves that what a person needs stands in the text, and that `print` shows it.
    found = observed(*packed(without(WELL, "depth"), at_truth=True))
    text = str(found)
    assert "weak directions: scale (undetermined)" in text
    assert "weak without lines: no more than with all" in text
    assert "keyframe 2: roll" in text
    assert "keyframe 0: roll" not in text
    assert max(map(len, text.splitlines())) <= 110


def test_it_traces_under_vmap() -> None:
    # Proves that the numeric part is pure: a batch has a leading axis everywhere.
    pairs = [packed(scene, at_truth=True) for scene in (WELL, without(WELL, "depth"))]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)
    shapes = jax.eval_shape(jax.vmap(observability), *stacked)
    assert all(leaf.shape[0] == 2 for leaf in jax.tree.leaves(shapes))
