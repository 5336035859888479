"""A frame's pose: what is believed, what is not, and how a lost camera is found again. Exact truth: the renderer's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from changed import changed
from recorded_run import ROLES, SETTINGS, black, run_over
from vggtgeo.models.classical import NoDepth, PatchFlow, PnpGeometry, SiftMatcher, global_descriptor
from vggtgeo.models.roles import DepthEstimate, Features, GeometryResult, PoseGuess, PoseQuery, Segments

from vggtgeo.datasets.frame import Frame
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.rigid import exponential
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.simulation import simulate
from vggtgeo.slam.global_map.joining import join_at_end, join_submaps, scale_submap
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.perception.rgbd_alignment import RgbdAlignment, _align, compile_alignment
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.pipeline import step
from vggtgeo.slam.run import frame_trajectory
from vggtgeo.slam.sparse_map.keyframe import make_keyframe
from vggtgeo.slam.sparse_map.map import submap_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking import relocalisation
from vggtgeo.slam.tracking.frame_tracking import FrameData, MotionPrior, TrackedFrame, TrackingInput, track
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality

SIZE = (320, 240)
FREE_ROLES = replace(ROLES, depth=NoDepth())
Room = tuple[list[Frame], Camera, Trajectory]


def _unlit(frame: Frame) -> Frame:
    return replace(frame, image=np.zeros_like(frame.image))


def _view(frame: Frame, intrinsics: np.ndarray, factor: float = 1.0) -> RgbdView:
    """As the sensor sees it, with `factor` times its noise."""
    depth, sigma = ROLES.tracking_depth(frame.depth)
    return RgbdView.of(frame.image, (depth, factor * sigma), intrinsics)


class _Guessing:
    """A depth from nowhere, 7 % off by its own account."""

    def estimate(self, image: np.ndarray, sensor_depth: object = None, intrinsics: object = None) -> DepthEstimate:
        whole = np.full(image.shape[:2], 2.0, np.float32)
        return DepthEstimate(whole, np.ones_like(whole), np.full_like(whole, 0.07))


def _error(slam: Slam, truth: Trajectory) -> float:
    return evaluate_trajectory(frame_trajectory(slam), truth).se3.statistics.rmse


def test_alignment_brings_a_wrong_start_to_the_true_motion(room: Room) -> None:
    """From 4 cm and 1.5 degrees off, brightness and surfaces lead to the true motion, and say how well it is known.

    Oracle: the renderer's poses; 5 mm and 0.3 degrees, and the error within 5 of the stated standard deviations.
    """
    frames, camera, truth = room
    intrinsics = np.array(camera.intrinsics)
    views = [_view(frames[i], intrinsics) for i in (0, 2)]
    poses = rigid.invert(truth.poses[[0, 2]])
    motion = poses[1] @ rigid.invert(poses[0])
    wrong = motion.copy()
    wrong[:3, :3] = cv2.Rodrigues(np.array([0.02, -0.015, 0.01]))[0] @ motion[:3, :3]
    wrong[:3, 3] += [0.03, -0.02, 0.02]
    found = RgbdAlignment().align(*views, wrong)
    off = np.linalg.norm(found.motion[:3, 3] - motion[:3, 3])
    assert off < 0.005, f"{1000 * off:.1f} mm"
    assert rigid.angle_between(found.motion, motion) < np.deg2rad(0.3)
    assert found.correlation > 0.8
    assert found.surface > 0.95
    sigma = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(found.information)[:3, :3])[-1])
    assert off < 5 * sigma, f"{1000 * off:.1f} mm with a standard deviation of {1000 * sigma:.1f} mm"


def test_tracking_takes_the_noise_that_the_depth_states(room: Room) -> None:
    """Surfaces alone (black pictures), once as the sensor states its noise and once with twice that: the information
    falls to a quarter. Oracle: information is 1 / sigma^2.
    """
    frames, camera, truth = room
    poses = rigid.invert(truth.poses[[0, 2]])
    found = []
    for factor in (1.0, 2.0):
        views = [_view(_unlit(frames[i]), np.array(camera.intrinsics), factor) for i in (0, 2)]
        found.append(RgbdAlignment().align(*views, poses[1] @ rigid.invert(poses[0])))
    once, twice = (each.information for each in found)
    np.testing.assert_allclose(once, 4 * twice, atol=0.01 * np.abs(once).max())


def test_what_is_compiled_ahead_is_what_is_needed(room: Room) -> None:
    """Alignments of a camera's views compile nothing more than was compiled for it; oracle: the number of programs."""
    frames, camera, _ = room
    compile_alignment(camera)
    before = len(_align._programs)
    views = [_view(frames[i], np.array(camera.intrinsics)) for i in (0, 2)]
    assert RgbdAlignment().align(*views, np.eye(4)) is not None
    assert len(_align._programs) == before


def test_a_network_depth_states_its_own_noise(room: Room) -> None:
    """A role other than a sensor tells keyframes its noise, and tracking nothing; oracle: the role's own numbers."""
    frames, camera, _ = room
    roles = replace(ROLES, depth=_Guessing())
    slam = run_over(frames[:1], camera, roles)
    np.testing.assert_allclose(slam.keyframes[0].depth_sigma, 0.07, rtol=1e-3)
    assert roles.tracking_depth(frames[0].depth) is None
    depth, sigma = ROLES.tracking_depth(np.full((4, 4), 2.0, np.float32))
    np.testing.assert_allclose(sigma, ROLES.depth.noise(depth))


def test_alignment_of_different_places_says_that_they_differ(room: Room) -> None:
    """Two views that share nothing get a correlation below the level of belief; oracle: the frames' true overlap."""
    frames, camera, _ = room
    intrinsics = np.array(camera.intrinsics)
    other = simulate("room", 2000, 0, SIZE, rate=10.0).frame(60)
    views = [_view(frame, intrinsics) for frame in (frames[0], other)]
    found = RgbdAlignment().align(*views, np.eye(4))
    assert found is None or found.correlation < 0.3


class _Counting(SiftMatcher):
    """Counts the images that it describes."""

    described = 0

    def describe(self, image: np.ndarray) -> Features:
        _Counting.described += 1
        return super().describe(image)


@pytest.mark.long
def test_frames_are_described_where_flow_fails(room: Room) -> None:
    """By flow most frames need no descriptors, and none where it has nothing to follow; both ways end near the truth.

    Oracles: the number of descriptions, and the renderer's poses, from which the run by descriptors is the reference.
    """
    frames, camera, truth = room[0][:16], *room[1:]
    errors = []
    for flow, least, most in (
        (PatchFlow(), 1, len(frames) // 2),
        (PatchFlow(similarity=0.999), 16, 16),
        (None, 16, 16),
    ):
        _Counting.described = 0
        slam = run_over(frames, camera, replace(ROLES, points=_Counting(count=500), flow=flow))
        assert least <= _Counting.described <= most, f"{_Counting.described} descriptions with {flow}"
        assert all(record.tracked for record in slam.frames)
        errors.append(_error(slam, truth))
    assert errors[1] == errors[2]
    assert errors[0] < max(1.5 * errors[2], 0.01), f"{100 * errors[0]:.2f} cm by flow, {100 * errors[2]:.2f} without"


def _by_lines(room: Room, keep: Callable[[np.ndarray], np.ndarray]) -> tuple[TrackedFrame, np.ndarray]:
    """Frame 2 against a keyframe at frame 0 by its segments alone, those that `keep` says of their ends [l, 2, 2], from
    4 cm and 2 degrees off; and the true pose.
    """
    frames, camera, truth = room
    poses, intrinsics = rigid.invert(truth.poses), np.array(camera.intrinsics)
    blank = Description.of(ROLES.points.describe(np.zeros_like(frames[0].image)))
    keyframe = make_keyframe(0, frames[0], poses[0], blank, ROLES, SETTINGS, intrinsics)
    segments = ROLES.lines.detect(frames[2].image)
    kept = keep(segments.endpoints)
    segments = Segments(segments.endpoints[kept], segments.scores[kept])
    data = FrameData(frames[2], blank, None, lambda: ROLES.line_matches.describe(frames[2].image, segments))
    wrong = exponential(np.array([0.03, -0.02, 0.02, 0.02, -0.025, 0.015])) @ poses[2]
    given = TrackingInput(data, intrinsics, ROLES, MotionPrior(wrong, np.eye(4)))
    return track(given, keyframe, None), poses[2]


def test_lines_alone_hold_a_frame(room: Room) -> None:
    """Without a key point and without depth of its own a frame is placed by its segments to 1 cm, and believed.

    Oracle: the renderer's poses.
    """
    found, true = _by_lines(room, lambda ends: np.ones(len(ends), bool))
    off = np.linalg.norm(rigid.centre(found.pose) - rigid.centre(true))
    assert off < 0.01, f"{1000 * off:.1f} mm"
    assert rigid.angle_between(found.pose, true) < np.deg2rad(0.3)
    assert found.accepted, found.quality


def test_lines_that_leave_a_direction_open_are_not_believed(room: Room) -> None:
    """The upright segments of the same frame leave the height open: no pose. Oracle: they are parallel in space."""

    def upright(ends: np.ndarray) -> np.ndarray:
        along = np.abs(ends[:, 1] - ends[:, 0])
        return along[:, 1] > 5 * along[:, 0]

    found, _ = _by_lines(room, upright)
    assert not found.accepted, found.quality


class _Mirage:
    """A pose solver that from a certain frame on is sure of a pose 2 m off, on 12 of its matches."""

    def __init__(self, start: int) -> None:
        self.calls, self.start_at, self.own = 0, start, PnpGeometry()

    def locate(self, query: PoseQuery) -> PoseGuess:
        self.calls += 1
        if self.calls < self.start_at:
            return self.own.locate(query)
        pose = np.eye(4) if query.predicted is None else query.predicted.copy()
        pose[:3, 3] += [2.0, 0.0, 0.0]
        return PoseGuess(pose, np.arange(len(query.points)) < 12, 0.5, GeometryResult.SUCCESS)

    def start(self, *arguments: object) -> object:
        raise NotImplementedError


def test_a_step_that_no_hand_makes_is_not_believed(room: Room) -> None:
    """A pose 2 m away on 12 inliers is refused: no frame is called tracked that is more than 5 cm off.

    Oracle: the renderer's poses, relative to those of the first frame.
    """
    frames, camera, truth = room
    slam = run_over(frames[:12], camera, replace(ROLES, geometry=_Mirage(6)))
    true = rigid.invert(truth.poses) @ truth.poses[0]
    assert any("tracking was lost" in note for note in slam.notes)
    for record in slam.frames:
        off = np.linalg.norm(rigid.centre(slam.pose(record)) - rigid.centre(true[record.frame]))
        assert not record.tracked or off < 0.05, f"frame {record.frame} is {off:.2f} m off and called tracked"


@pytest.mark.parametrize(
    ("quality", "believed"),
    [
        (TrackingQuality(matches=55, inliers=28, correlation=0.38, surface=0.99, overlap=0.5, chi2=300.0), False),
        (TrackingQuality(matches=51, inliers=12, chi2=4.0), False),
        (TrackingQuality(matches=20, inliers=14, correlation=0.7, surface=0.95, overlap=0.6, chi2=4.0), True),
        (TrackingQuality(matches=0, inliers=0, correlation=0.75, surface=0.97, overlap=0.6, chi2=4.0), True),
        (TrackingQuality(matches=300, inliers=280, correlation=-0.1, surface=0.5, overlap=0.5, chi2=4.0), False),
        (TrackingQuality(matches=90, inliers=80, sigma_translation=0.4, chi2=4.0), False),
        (TrackingQuality(lines=20, visible_lines=35, sigma_translation=0.02, chi2=4.0), True),
        (TrackingQuality(lines=20, visible_lines=35, sigma_translation=0.4, chi2=4.0), False),
        (TrackingQuality(lines=20, visible_lines=70, sigma_translation=0.02, chi2=4.0), False),
    ],
)
def test_what_is_believed(quality: TrackingQuality, believed: bool) -> None:
    """Two witnesses or one beyond doubt; oracle: cases measured on real pairs of frames, right and wrong."""
    assert quality.accepted is believed


@pytest.mark.parametrize(
    ("old", "present", "well"), [(0.51, 0.93, False), (0.85, 0.95, True), (0.5, 0.6, True), (float("nan"), 0.9, True)]
)
def test_an_old_keyframe_shows_a_frame_as_well_as_the_present_one(old: float, present: float, well: bool) -> None:
    """Half the correlation is not as well; nothing to compare is no reason against. Oracle: the definition."""
    assert TrackingQuality(correlation=old).shows_as_well(TrackingQuality(correlation=present)) is well


def test_black_frames_are_lost_and_the_map_goes_on(room: Room) -> None:
    """Five black frames are called lost, all others are tracked in one map; oracle: the renderer's poses."""
    frames, camera, truth = room
    dark = range(12, 17)
    slam = run_over([black(frame) if frame.index in dark else frame for frame in frames], camera)
    assert [record.frame for record in slam.frames if not record.tracked] == list(dark)
    assert len(slam.map.roots) == 1
    assert len(frame_trajectory(slam)) == len(frames) - len(dark), "a frame without a pose is not in the trajectory"
    assert _error(slam, truth) < 0.015


@pytest.mark.long
def test_a_camera_that_comes_back_is_found_again(room: Room) -> None:
    """Away to a place never seen and back at the clip's beginning: found in the old map; oracle: the true poses."""
    frames, camera, truth = room
    other = simulate("room", 2000, 0, SIZE, rate=10.0)
    away = [replace(other.frame(60 + i), index=24 + i, timestamp=(24 + i) / 10) for i in range(5)]
    back = [replace(frames[2 + i], index=29 + i, timestamp=(29 + i) / 10) for i in range(6)]
    slam = run_over([*frames[:24], *away, *back], camera)
    assert len(slam.map.roots) == 1
    assert any("found again" in note for note in slam.notes), slam.notes
    true = rigid.invert(truth.poses) @ truth.poses[0]
    for record in slam.frames[24:29]:
        assert not record.tracked
    for record in slam.frames[29:]:
        off = np.linalg.norm(rigid.centre(slam.pose(record)) - rigid.centre(true[record.frame - 27]))
        assert record.tracked
        assert off < 0.03, f"frame {record.frame} is {100 * off:.1f} cm off"


def test_a_keyframe_without_a_match_is_tied(room: Room) -> None:
    """Frames whose key points match nothing still hang on the map by their surfaces; oracle: the renderer's poses."""
    frames, camera, truth = room
    blurred = range(14, 22)
    soft = [
        replace(frame, image=cv2.GaussianBlur(frame.image, (0, 0), 4.0)) if frame.index in blurred else frame
        for frame in frames
    ]
    slam = run_over(soft, camera)
    assert all(record.tracked for record in slam.frames)
    tied = {factor.keyframes[1] for factor in slam.map.factors}
    assert tied == set(range(1, len(slam.keyframes))), "every keyframe but the first is tied to another"
    assert _error(slam, truth) < 0.025


def test_a_place_is_recognised(room: Room) -> None:
    """The vector of a frame is nearer to that of its neighbour than to that of any distant one; oracle: time."""
    frames, _, _ = room
    matcher = SiftMatcher(count=500)
    places = [global_descriptor(matcher.describe(frames[i].image)) for i in (0, 1, 10, 16, 23)]
    similarity = [float(places[0] @ place) for place in places[1:]]
    assert int(np.argmax(similarity)) == 0, similarity


@pytest.fixture(scope="module")
def tracked(room: Room) -> Slam:
    """After all frames."""
    return run_over(*room[:2])


@pytest.mark.long
@pytest.mark.parametrize("contradicted", [False, True])
def test_a_place_that_drift_has_moved_is_used_again(
    room: Room, tracked: Slam, monkeypatch: pytest.MonkeyPatch, contradicted: bool
) -> None:
    """Old keyframes 40 cm off, as drift would have them: on the way back the camera is tracked against one of them
    again, and a motion ties the old to the new. Where odometry says that they are 2 m away, the place only looks the
    same, and nothing ties it. Oracle: the renderer's poses, relative to the old keyframe.
    """
    monkeypatch.setattr(relocalisation, "MAX_DRIFT", 1.0)  # the room is small for so much drift
    frames, _, truth = room
    slam, old = tracked, 2
    assert min(slam.window.members) > old - 1
    drift, away = np.eye(4), np.eye(4)
    drift[:3, 3] = 0.3, 0.0, 0.26
    away[2, 3] = 2.0
    moved = (replace(k, pose=k.pose @ drift) if k.number < old else k for k in slam.keyframes)
    crossing = lambda factor: min(factor.keyframes) < old <= max(factor.keyframes)
    # As if the way to here had been long, no motion ties the two parts directly; or one that puts them elsewhere.
    cut = tuple(
        replace(factor, pose=away @ factor.pose)
        for factor in slam.map.odometry_factors
        if crossing(factor) and contradicted
    )
    kept = (*(factor for factor in slam.map.factors if not crossing(factor)), *cut)
    slam = changed(slam, "map", keyframes=tuple(moved), factors=kept)
    played = [*range(len(frames) - 1, -1, -2)]
    for index, row in enumerate(played, start=len(frames)):
        frame = replace(frames[row], index=index, timestamp=index / 10)
        slam = step(slam, frame, Description.of(ROLES.points.describe(frame.image)), ROLES, SETTINGS)
    back = [record for record in slam.frames[len(frames) :] if record.tracked and record.reference < old]
    new = [factor for factor in slam.map.odometry_factors if crossing(factor) and factor not in cut]
    if contradicted:
        assert not back
        assert not new
        return
    assert back, "no frame of the way back hangs on an old keyframe"
    assert new
    true = rigid.invert(truth.poses)
    for record in back:
        reference = slam.keyframes[record.reference].frame
        expected = true[played[record.frame - len(frames)]] @ rigid.invert(true[reference])
        off = np.linalg.norm(rigid.centre(record.relative) - rigid.centre(expected))
        assert off < 0.03, f"frame {record.frame} is {100 * off:.1f} cm off"


@pytest.fixture(scope="module")
def torn(room: Room) -> tuple[Slam, Slam]:
    """A map whose scale is free, and the same with its last third 1.6 times too large, elsewhere, and joined to
    the rest by nothing.
    """
    frames, camera, _ = room
    seen = [replace(f, index=i, timestamp=i / 10) for i, f in enumerate((*frames[:16], *frames[14:4:-1]))]
    whole = run_over(seen, camera)
    whole = changed(whole, "map", metric=False)
    origin = 2 * len(whole.keyframes) // 3
    own = lambda ends: len({number < origin for number in ends}) == 1
    torn_apart = changed(
        whole,
        "map",
        roots=(0, origin),
        pairs=tuple(pair for pair in whole.map.pairs if own(pair.key)),
        factors=tuple(factor for factor in whole.map.factors if own(factor.keyframes)),
    )
    apart = scale_submap(torn_apart, 1.6, range(origin, len(whole.keyframes)))
    moved = np.eye(4)
    moved[:3, :3] = cv2.Rodrigues(np.array([0.3, -0.8, 0.2]))[0]
    moved[:3, 3] = [0.5, -1.0, 2.0]
    keyframes = tuple(replace(k, pose=k.pose @ moved) if k.number >= origin else k for k in apart.keyframes)
    return whole, changed(apart, "map", keyframes=keyframes)


def test_submaps_of_free_scale_join_by_a_similarity(room: Room, torn: tuple[Slam, Slam]) -> None:
    """The last third of a map whose scale is free, 1.6 times too large and elsewhere, comes back where it was when its
    newest keyframe shows the rest. Oracle: the map before it was taken apart.
    """
    whole, apart = torn
    newest = whole.keyframes[-1]
    shown = [*room[0][:16], *room[0][14:4:-1]][newest.frame]
    data = FrameData(replace(shown, index=newest.frame), Description.of(newest.features), None)
    _check_joined(whole, join_submaps(apart, data, FREE_ROLES, SETTINGS))


def test_submaps_that_never_met_join_at_the_end(torn: tuple[Slam, Slam]) -> None:
    """The same by all keyframes that look alike, when the run is over. Oracle: the map before it was taken apart."""
    whole, apart = torn
    _check_joined(whole, join_at_end(apart, FREE_ROLES))


def _check_joined(whole: Slam, joined: Slam) -> None:
    """One submap, each keyframe where it was as seen from the first one, to 5 cm, and depths to 5 %, in the
    unit of the first.
    """
    assert len(joined.map.roots) == 1, joined.notes
    assert len(set(submap_of(joined.map))) == 1
    first, now = whole.keyframes[0], joined.keyframes[0]
    unit = float(np.nanmedian(now.points.inverse_depth / first.points.inverse_depth))
    for before, after in zip(whole.keyframes, joined.keyframes, strict=True):
        expected, found = before.pose @ rigid.invert(first.pose), after.pose @ rigid.invert(now.pose)
        off = np.linalg.norm(expected[:3, 3] - unit * found[:3, 3])
        assert off < 0.05, f"keyframe {before.number} is {100 * off:.1f} hundredths of the unit off"
        np.testing.assert_allclose(after.points.inverse_depth, unit * before.points.inverse_depth, rtol=0.05)
