"""The pipeline on a few synthetic frames with exact truth, and on input that is bad."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import numpy as np
import pytest
from recorded_run import ROLES, SETTINGS, black, run_over
from scipy.spatial.transform import Rotation
from vggtgeo.models.classical import NoDepth, SiftMatcher
from vggtgeo.models.roles import Features, PointMatches

from vggtgeo.bundle.terms.measured_pose import RelativePose
from vggtgeo.datasets.frame import Frame
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.results.files import write_trajectories
from vggtgeo.results.summary import list_submaps
from vggtgeo.simulation import simulate
from vggtgeo.slam.global_map.compile_ahead import expected_keyframes
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.global_map.global_adjustment import adjust_all
from vggtgeo.slam.global_map.loops import close_loops
from vggtgeo.slam.local_mapping import adjust_window, camera_prior, window_around
from vggtgeo.slam.run import finish, frame_trajectory
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.settings.table import updated
from vggtgeo.slam.sparse_map.factors import FREE_LENGTH
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window.sliding_window import window_problem

SIZE = (320, 240)
Room = tuple[list[Frame], Camera, Trajectory]


@pytest.fixture(scope="module")
def tracked(room: Room) -> Slam:
    return run_over(*room[:2])


def test_rgbd_recovers_the_truth(room: Room, tracked: Slam) -> None:
    """ATE below 1.5 cm on a synthetic room with sensor noise, every frame tracked; oracle: the renderer's poses."""
    report = evaluate_trajectory(frame_trajectory(tracked), room[2])
    error = report.se3.statistics.rmse
    assert all(record.tracked for record in tracked.frames)
    assert len(tracked.keyframes) > SETTINGS.window.size, "no keyframe ever left the window"
    assert error < 0.015, f"ATE {error:.4f} m"


def test_single_precision_of_the_caller_changes_nothing(room: Room, tracked: Slam) -> None:
    """A caller who has not switched 64-bit types on gets the same path; oracle: the run with them, bit for bit."""
    frames, camera, _ = room
    with jax.enable_x64(False):
        again = run_over(frames, camera)
    np.testing.assert_array_equal(frame_trajectory(again).poses, frame_trajectory(tracked).poses)


def test_a_second_run_compiles_nothing_however_long_its_windows_take(
    room: Room, tracked: Slam, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows are adjusted beside tracking, and taken up at a frame, not at a time: a second pass whose windows come
    late has the same poses, bit for bit, and compiles nothing. Oracles: the run in which they come early; JAX's own
    events of compilation.
    """
    frames, camera, _ = room
    compiled: list[str] = []

    def listen(event: str, _: float, **__: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    def late(slam: Slam, settings: SlamSettings) -> Slam:
        time.sleep(0.1 * (len(slam.keyframes) % 3))
        return adjust_window(slam, settings)

    monkeypatch.setattr("vggtgeo.slam.pipeline.adjust_window", late)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        jax.jit(lambda x: x + len(frames))(np.ones(3))
        assert compiled, "the event that is counted is not sent any more"
        compiled.clear()
        again = run_over(frames, camera)
    finally:
        jax.monitoring.clear_event_listeners()
    assert len(again.keyframes) > SETTINGS.window.size
    assert not compiled, f"{len(compiled)} programs were compiled"
    np.testing.assert_array_equal(frame_trajectory(again).poses, frame_trajectory(tracked).poses)


def _keyframe_error(slam: Slam, truth: Trajectory) -> float:
    """Root mean square of the keyframes' places after alignment, metres."""
    poses = rigid.invert(np.array([keyframe.pose for keyframe in slam.keyframes]))
    times = np.array([keyframe.timestamp for keyframe in slam.keyframes])
    return evaluate_trajectory(Trajectory(times, poses), truth).se3.statistics.rmse


def _shaken(slam: Slam, metres: float, degrees: float, from_keyframe: int = 1, together: bool = False) -> Slam:
    """The map with its keyframes moved by so much in random directions, each by itself or all together."""
    rng, keyframes = np.random.default_rng(0), list(slam.keyframes)
    directions = [[way / np.linalg.norm(way) for way in rng.normal(size=(2, 3))] for _ in keyframes]
    for number in range(from_keyframe, len(keyframes)):
        shift, axis = directions[0 if together else number]
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
        # About the camera's own centre, or about the world's.
        centre = np.zeros(3) if together else rigid.centre(keyframes[number].pose)
        motion[:3, 3] = centre + metres * shift - motion[:3, :3] @ centre
        keyframes[number] = replace(keyframes[number], pose=keyframes[number].pose @ rigid.invert(motion))
    return slam.with_map(keyframes=tuple(keyframes))


@pytest.mark.parametrize(
    "surfaces", [pytest.param(300.0, id="with surfaces"), pytest.param(0.0, id="matches alone", marks=pytest.mark.slow)]
)
def test_global_adjustment_brings_a_map_back(room: Room, tracked: Slam, surfaces: float) -> None:
    """Keyframes moved by 5 cm and 2 degrees each come back to below 1 cm; oracle: the renderer's poses."""
    changes = {"refinement": {"global_adjustment": True}, "depth_terms": {"surface_points": surfaces}}
    settings = updated(SETTINGS, changes)
    wrong = _shaken(tracked, 0.05, 2.0)
    assert _keyframe_error(wrong, room[2]) > 0.03
    error = _keyframe_error(finish(wrong, ROLES, settings), room[2])
    assert error < 0.01, f"{error:.4f} m"


def test_the_size_of_the_map_is_foreseen_a_few_times() -> None:
    """At a quarter of the frames a map of 5 keyframes will have 20; between checks, and long before the end, nothing
    is foreseen, and without an end the map itself counts; oracle: by hand.
    """
    assert expected_keyframes(5, 25, 100, 0.1) == 20
    assert [expected_keyframes(5, *at) for at in ((26, 100, 0.1), (25, 100, 1.0))] == [None, None]
    assert [expected_keyframes(count, 31, None, 1.0) for count in (7, 8, 70)] == [None, 8, 70]


def test_a_window_of_three_around_an_old_keyframe_keeps_it(tracked: Slam) -> None:
    around = window_around(tracked, 1, updated(SETTINGS, {"window": {"size": 3}})).window
    assert (around.members, around.fixed) == ((0, 1), (1,))


@pytest.mark.long
def test_a_loop_joins_what_has_come_apart(room: Room, tracked: Slam) -> None:
    """A map cut in two, its later part moved by 5 cm and 2 degrees: only matches of places seen before join it again.

    Oracle: the renderer's poses; and the same adjustment without the loops, which leaves the parts where they are.
    """
    middle, settings = len(tracked.keyframes) // 2, updated(SETTINGS, {"depth_terms": {"surface_points": 0.0}})
    apart = _shaken(tracked, 0.05, 2.0, from_keyframe=middle, together=True)
    within = [pair for pair in apart.map.pairs if (pair.first < middle) == (pair.second < middle)]
    tied = [f for f in apart.map.factors if len({number < middle for number in f.keyframes}) == 1]
    apart = apart.with_map(pairs=tuple(within), factors=tuple(tied))
    assert len(within) < len(tracked.map.pairs)
    closed = close_loops(apart, ROLES, settings)
    assert any(pair.first < middle <= pair.second for pair in closed.map.pairs[len(within) :])
    error = _keyframe_error(adjust_all(closed, settings), room[2])
    assert error < 0.01, f"{error:.4f} m"
    assert _keyframe_error(adjust_all(apart, settings), room[2]) > 0.015


def _visited_twice(slam: Slam, motion: np.ndarray) -> Slam:
    """The map with every keyframe once more, as of a second visit that began a submap of its own, off by `motion`."""
    count = len(slam.keyframes)
    again = tuple(replace(k, number=k.number + count, pose=k.pose @ rigid.invert(motion)) for k in slam.keyframes)
    pairs = tuple(replace(p, first=p.first + count, second=p.second + count) for p in slam.map.pairs)
    factors = tuple(replace(t, first=t.first + count, second=t.second + count) for t in slam.map.odometry_factors)
    twice = slam.with_map(keyframes=(*slam.keyframes, *again), pairs=(*slam.map.pairs, *pairs), roots=(0, count))
    return twice.with_factors(*factors)


@pytest.mark.long
def test_a_second_visit_far_off_is_brought_back(tracked: Slam) -> None:
    """A second visit 3 m and 40 degrees away, where no keyframe should see what the first visit saw: what it looks like
    finds it, and a pose graph brings it back before the adjustment. Oracle: the keyframes of the first visit.
    """
    settings = updated(SETTINGS, {"depth_terms": {"surface_points": 0.0}})
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(np.deg2rad(40.0) * np.array([0.2, 0.97, 0.1])).as_matrix()
    motion[:3, 3] = 2.0, 0.5, -2.0
    count = len(tracked.keyframes)
    closed = close_loops(_visited_twice(tracked, motion), ROLES, settings)
    assert any("corrected the drift" in note for note in closed.notes), closed.notes
    assert sum(pair.first < count <= pair.second for pair in closed.map.pairs) >= 3
    for slam, bound in ((closed, 0.10), (adjust_all(closed, settings), 0.005)):
        poses = np.array([keyframe.pose for keyframe in slam.keyframes])
        centres = rigid.invert(poses)[:, :3, 3]
        off = np.linalg.norm(centres[count:] - centres[:count], axis=1).max()
        assert off < bound, f"{off:.4f} m"


@pytest.mark.long
def test_rgb_recovers_the_shape(room: Room) -> None:
    """Without depth the trajectory is right up to scale, and the state says that lengths are not metres."""
    frames, camera, truth = room
    colour = [replace(frame, depth=None) for frame in frames]
    slam = run_over(colour, camera, replace(ROLES, depth=NoDepth()))
    error = evaluate_trajectory(frame_trajectory(slam), truth).sim3.statistics.rmse
    assert not slam.metric
    assert len(slam.frames) == len(frames)
    assert error < 0.03, f"ATE after Sim(3) {error:.4f} m"
    _, poses = frame_poses(slam)
    for keyframe in slam.keyframes:
        assert np.array_equal(poses[keyframe.frame], keyframe.pose)  # the second one began the map with the first
    numbers = {keyframe.frame for keyframe in slam.keyframes}
    between = [record.quality for record in slam.frames if record.frame not in numbers]
    assert all(np.isfinite(quality.sigma_translation) for quality in between)  # and of those that waited for the map
    assert len(slam.map.odometry_factors) >= len(slam.keyframes) - 2
    prior = camera_prior(slam)
    adjustment, _ = window_problem(slam.map, slam.window, slam.intrinsics, prior, SETTINGS)
    (motions,) = (term for term in adjustment.problem.terms if isinstance(term, RelativePose))
    present = np.asarray(motions.weight) > 0
    roots, lengths = np.asarray(motions.root)[present], rigid.to_matrix(np.asarray(motions.measured))[present, :3, 3]
    assert len(roots)
    for root, length in zip(roots, lengths, strict=True):  # the unit is no measurement of any motion
        assert np.linalg.norm(root[:, :3] @ length) <= 1.001 / FREE_LENGTH


@dataclass(frozen=True)
class _Dense:
    """A matcher whose targets are no key points, as MASt3R's are."""

    own: SiftMatcher = field(default_factory=lambda: SiftMatcher(count=500))

    def describe(self, image: np.ndarray) -> Features:
        return self.own.describe(image)

    def match(self, features_i: Features, features_j: Features, predicted: np.ndarray | None = None) -> PointMatches:
        found = self.own.match(features_i, features_j, predicted)
        return replace(found, index_j=np.full(len(found), -1))


def _blind(frames: list[Frame], numbers: Iterable[int]) -> list[Frame]:
    """The frames, those of `numbers` without a valid depth."""
    nothing = np.full((SIZE[1], SIZE[0]), np.nan, np.float32)
    return [replace(frame, depth=nothing) if frame.index in numbers else frame for frame in frames]


def test_a_map_begins_where_depth_does(room: Room) -> None:
    """Depth that fails on the first three frames costs neither the scale nor their poses; oracle: the true poses."""
    frames, camera, truth = room
    slam = run_over(_blind(frames, range(3)), camera)
    error = evaluate_trajectory(frame_trajectory(slam), truth).se3.statistics.rmse
    assert slam.metric
    assert all(record.tracked for record in slam.frames)
    assert any("the map begins at frame 3" in note for note in slam.notes), slam.notes
    assert error < 0.015, f"ATE {error:.4f} m"
    assert all(0 < record.quality.sigma_translation < 0.05 for record in slam.frames[:3])  # those that waited


@pytest.mark.long
def test_depth_that_fails_on_keyframes_leaves_map_and_scale(room: Room, tracked: Slam) -> None:
    """Keyframes without depth, where matches end at no key point, neither start a new map nor change the scale.

    Oracle: the renderer's poses.
    """
    frames, camera, truth = room
    blind = [keyframe.frame for keyframe in tracked.keyframes[1:]][::3]
    slam = run_over(_blind(frames, blind), camera, replace(ROLES, points=_Dense()))
    assert len(blind) >= 2
    assert any(keyframe.frame in blind for keyframe in slam.keyframes), "no keyframe was without depth"
    error = evaluate_trajectory(frame_trajectory(slam), truth).se3.statistics.rmse
    assert slam.metric
    assert len(slam.map.roots) == 1
    assert error < 0.02, f"ATE {error:.4f} m"


BAD: dict[str, Callable[[list[Frame]], list[Frame]]] = {
    "one frame": lambda frames: frames[:1],
    "still camera": lambda frames: [replace(frames[0], index=i, timestamp=i / 10) for i in range(5)],
    "black from the start": lambda frames: [black(frame) for frame in frames[:3]],
    "no valid depth": lambda frames: _blind(frames[:4], range(4)),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_sequences_end_with_finite_poses(room: Room, name: str) -> None:
    """Whatever the frames show, nothing raises, and each frame has a finite pose or is said to have none."""
    frames = BAD[name](room[0])
    slam = run_over(frames, room[1])
    poses = frame_trajectory(slam).poses
    assert len(slam.frames) == len(frames)
    assert len(poses) == sum(record.tracked for record in slam.frames) > 0
    assert np.all(np.isfinite(poses))


@pytest.mark.long
def test_a_jump_is_said_and_survived(room: Room, tmp_path: Path) -> None:
    """After a jump to a place never seen, tracking is reported lost, the map goes on from a new origin, and each submap
    is written to a file of its own, the one of more frames first. Oracle: which frames are of which place.
    """
    frames, camera, _ = room
    other = simulate("room", 2000, 0, SIZE, rate=10.0)
    elsewhere = [replace(other.frame(60 + i), index=8 + i, timestamp=(8 + i) / 10) for i in range(14)]
    slam = run_over([*frames[:8], *elsewhere], camera)
    assert any("tracking was lost at frame 8" in note for note in slam.notes), slam.notes
    assert len(slam.map.roots) == 2
    assert len(slam.frames) == 22
    (tmp_path / "trajectory-5.txt").write_text("of a submap that was joined since")
    write_trajectories(tmp_path, slam)
    told = list_submaps(slam)
    assert [submap["trajectory"] for submap in told] == ["trajectory.txt", "trajectory-2.txt"]
    assert sorted(file.name for file in tmp_path.glob("traj*")) == ["trajectory-2.txt", "trajectory.txt"]
    times = [Trajectory.load_tum(tmp_path / submap["trajectory"]).timestamps for submap in told]
    assert times[0].min() > 0.75, "the jump's place has more frames"
    np.testing.assert_allclose(times[1], np.arange(8) / 10)
    assert [submap["poses"] for submap in told] == [len(own) for own in times]
    assert told[1]["frames"] == [0, 7]
