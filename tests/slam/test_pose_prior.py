"""Recorded poses as a prior: carried over black frames, compared with the images, and dropped where they are others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.posed_keyframes import keyframe_of, slots_of
from recorded_run import ROLES, black, run_over
from scipy.spatial.transform import Rotation
from vggtgeo.models.classical import NoDepth

from vggtgeo.datasets.frame import Frame
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.simulation import simulate
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.pose_prior import prior_summary, with_recorded_factors
from vggtgeo.slam.pose_prior_check import SIGNIFICANT, compare
from vggtgeo.slam.run import frame_trajectory
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.map import Map, longer, scaled_factor, scaled_keyframe, submap_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracking_state import FramePose, Tracker

SIZE = (320, 240)
DARK = range(16, 26)
"""Frames of the walk in which the camera turns by 97 degrees: what is seen before is not seen after."""
SHOWN = 32
"""Frames of the walk that there are pictures of."""
Walk = tuple[list[Frame], Camera, Trajectory]


@pytest.fixture(scope="module")
def walk() -> Walk:
    """Frames 18 to 49 of a walk through an office, black while the camera turns; and the truth of frames 18 to 53."""
    sequence = simulate("office", 60, 0, SIZE, rate=5.0)
    truth = sequence.ground_truth()
    frames = sequence.frames(18, 18 + SHOWN)
    dark = [black(frame) if row in DARK else frame for row, frame in enumerate(frames)]
    return dark, sequence.camera, truth.select(slice(18, 54))


def _run(walk: Walk, roles: Roles) -> Slam:
    frames, camera, _ = walk
    if not roles.metric:
        frames = [replace(frame, depth=None) for frame in frames]
    return run_over(frames, camera, roles)


def _disturbed(truth: Trajectory, drift: float = 0.02, scale: float = 1.05) -> Trajectory:
    """The truth as a phone records it: another world, another unit, drift along the way and about the vertical."""
    poses = truth.poses.copy()
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1))])
    turned = Rotation.from_rotvec(np.outer(np.deg2rad(1.0) / 60 * (truth.timestamps - truth.timestamps[0]), [0, 0, 1]))
    poses[:, :3, :3] = turned.as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * (poses[:, :3, 3] + np.outer(drift * way, [0.6, 0.8, 0.0]))
    world = rigid.exponential(np.array([3.0, -2.0, 1.0, 0.4, -0.9, 2.0]))
    return Trajectory(truth.timestamps, world @ poses)


def _other(truth: Trajectory) -> Trajectory:
    """A recording of another part of a long walk, at the same times."""
    other = simulate("office", 160, 0, SIZE, rate=5.0).ground_truth()
    return Trajectory(truth.timestamps, other.poses[100 : 100 + len(truth)])


def _ties(truth: Trajectory, noise: float, rng: np.random.Generator) -> Map:
    """Keyframes at the poses of the truth, tied by motions that images measured to within some noise."""
    poses = rigid.invert(truth.poses)
    nothing, image = slots_of(np.zeros((0, 2)), np.zeros(0)), np.zeros((1, 1, 3), np.uint8)
    keyframes = tuple(
        replace(keyframe_of(number, image, pose, nothing, np.ones((1, 1))), timestamp=float(time))
        for number, (pose, time) in enumerate(zip(poses, truth.timestamps, strict=True))
    )
    sigma = np.repeat([noise, noise / 3], 3)
    factors = tuple(
        MeasuredRelativePose(
            *(row, row + 1, rigid.exponential(rng.normal(size=6) * sigma) @ poses[row + 1] @ rigid.invert(poses[row])),
            information=np.diag(1 / sigma**2),
        )
        for row in range(len(poses) - 1)
    )
    return Map(metric=True, keyframes=keyframes, factors=factors, roots=(0,))


def test_a_pose_between_two_recorded_ones_is_on_the_way() -> None:
    """Half way of a turn about a fixed axis is half of its angle; a time in a gap, or outside, has none."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    for row in range(5):
        poses[row, :3, :3] = Rotation.from_rotvec([0, 0.1 * row, 0]).as_matrix()
    times = np.array([0.0, 1.0, 2.0, 3.0, 9.0])
    recorded = RecordedPoses(Trajectory(times, poses))
    found = recorded.pose(1.5)
    np.testing.assert_allclose(Rotation.from_matrix(found[:3, :3]).as_rotvec(), [0, -0.15, 0], atol=1e-12)
    assert recorded.pose(5.0) is None
    assert recorded.pose(-0.1) is None
    assert recorded.motion(0.0, 9.5) is None


def test_the_unit_of_a_recording_is_found(walk: Walk) -> None:
    """Its lengths are 1.05 of the map's: the unit is the inverse; oracle: the scale that the recording was given."""
    truth = walk[2]
    found = compare(RecordedPoses(_disturbed(truth)), _ties(truth, 0.003, np.random.default_rng(0)))
    assert found.accepted
    assert found.scale is not None
    assert abs(found.scale * 1.05 - 1) < 0.02


def test_wrongly_tracked_motions_do_not_decide(walk: Walk) -> None:
    """Two thirds of the last 20 motions are wrong, and the whole record still tells that the recording is right."""
    truth, rng = walk[2], np.random.default_rng(1)
    known = _ties(truth, 0.003, rng)
    wrong = {*range(15, 35)} - {*range(15, 35, 3)}
    factors = [
        replace(factor, pose=rigid.exponential(rng.normal(size=6) * 0.3) @ factor.pose) if row in wrong else factor
        for row, factor in enumerate(known.odometry_factors)
    ]
    assert compare(RecordedPoses(_disturbed(truth)), replace(known, factors=tuple(factors))).accepted


def test_motions_of_any_other_time_are_no_evidence(walk: Walk) -> None:
    """Recordings of the same motions in another order are accepted in one run of 10,000 (Ville's inequality): in none
    of 100 here. The mean of the ratio of likelihoods is at most 1 to within its spread.
    """
    truth, rng = walk[2], np.random.default_rng(2)
    known = _ties(truth, 0.003, rng)
    motions = [factor.pose for factor in known.odometry_factors]
    found = []
    for _ in range(100):
        poses = [np.eye(4)]
        for row in rng.permutation(len(motions)):
            poses.append(motions[row] @ poses[-1])
        found.append(compare(RecordedPoses(Trajectory(truth.timestamps, rigid.invert(np.array(poses)))), known))
    evidence = np.array([one.evidence for one in found])
    assert evidence.max() < SIGNIFICANT, evidence.max()
    assert np.exp(evidence).mean() < 1.0 + 3 * np.exp(evidence).std() / 10


def test_motions_that_are_all_alike_tell_nothing(walk: Walk) -> None:
    """On a straight way at one speed the recording is neither accepted nor contradicted, though every motion agrees."""
    truth = walk[2]
    poses = np.tile(np.eye(4), (len(truth), 1, 1))
    poses[:, 2, 3] = 0.2 * np.arange(len(truth))
    straight = Trajectory(truth.timestamps, poses)
    found = compare(RecordedPoses(straight), _ties(straight, 0.003, np.random.default_rng(0)))
    assert not found.accepted
    assert not found.contradicted


def test_submaps_are_joined_in_the_unit_of_the_recording(walk: Walk) -> None:
    """Two submaps of free scale, the second in a world of its own, twice as large, and with a scale that drifts by 3 %
    a keyframe, become one in the lengths of the recording; a frame without a pose gets the recorded one. Oracle: the
    poses that the recording was made of.
    """
    truth, camera = walk[2], walk[1]
    known = _ties(truth, 0.001, np.random.default_rng(0))
    first = 20
    scale = np.where(np.arange(len(truth)) < first, 1.0, 2.0 * 1.03 ** (np.arange(len(truth)) - first))
    poses = [keyframe.pose for keyframe in known.keyframes]
    poses[first] = poses[first] @ rigid.exponential(np.array([1.0, 2.0, -1.0, 0.3, 0.2, -0.5]))
    for row in range(first, len(truth) - 1):
        motion = known.keyframes[row + 1].pose @ rigid.invert(known.keyframes[row].pose)
        poses[row + 1] = longer(motion, scale[row]) @ poses[row]
    keyframes = tuple(
        replace(scaled_keyframe(keyframe, float(scale[keyframe.number])), pose=poses[keyframe.number])
        for keyframe in known.keyframes
    )
    factors = tuple(
        scaled_factor(factor, float(scale[factor.first])) for factor in known.odometry_factors if factor.second != first
    )
    records = [FramePose(row, float(time), row, np.eye(4), True, 50) for row, time in enumerate(truth.timestamps)]
    lost = FramePose(99, float(truth.timestamps[-1]) + 0.05, 35, np.eye(4), False, 0)
    slam = Slam(
        Map(metric=False, keyframes=keyframes, factors=factors, roots=(0, first)),
        CameraEstimate.of(camera),
        tracker=Tracker(frames=(*records, lost)),
    )
    beyond = Trajectory(
        np.append(truth.timestamps, truth.timestamps[-1] + 0.1), np.concatenate([truth.poses, truth.poses[-1:]])
    )
    recorded = RecordedPoses(_disturbed(beyond, drift=0.0))
    joined = with_recorded_factors(slam, replace(ROLES, depth=NoDepth(), recorded=recorded))
    assert submap_of(joined.map).max() == 0
    assert joined.map.roots == (0,)
    error = evaluate_trajectory(frame_trajectory(joined), recorded.trajectory)
    assert error.se3.statistics.rmse < 0.03, error.se3.statistics.rmse
    assert joined.frames[-1].tracked


def test_another_recording_is_contradicted(walk: Walk) -> None:
    """Poses of another walk, and those of this one a second late, agree with few motions of the images."""
    truth = walk[2]
    known = _ties(truth, 0.003, np.random.default_rng(0))
    late = Trajectory(truth.timestamps + 1.0, truth.poses)
    assert compare(RecordedPoses(_other(truth)), known).contradicted
    assert compare(RecordedPoses(late), known).contradicted


def test_black_frames_are_bridged(walk: Walk) -> None:
    """The camera turns in the dark, and the map stays in one submap; without recorded poses it falls apart. Oracle: the
    renderer's poses.
    """
    truth = walk[2]
    torn = _run((walk[0][: DARK.start + 2], *walk[1:]), ROLES)
    assert not all(record.tracked for record in torn.frames)
    slam = _run(walk, replace(ROLES, recorded=RecordedPoses(_disturbed(truth))))
    assert submap_of(slam.map).max() == 0
    assert all(record.tracked for record in slam.frames)
    assert evaluate_trajectory(frame_trajectory(slam), truth).se3.statistics.rmse < 0.03
    assert prior_summary(slam, replace(ROLES, recorded=RecordedPoses(_disturbed(truth))))["pose_prior"]["used"]


def test_another_recording_changes_nothing(walk: Walk) -> None:
    """With poses of another walk the run is that without, bit for bit, and says that they are not used."""
    frames, camera, truth = walk
    bright = frames[:10], camera, truth
    roles = replace(ROLES, recorded=RecordedPoses(_other(truth)))
    slam, plain = _run(bright, roles), _run(bright, ROLES)
    np.testing.assert_array_equal(frame_trajectory(slam).poses, frame_trajectory(plain).poses)
    ended = with_recorded_factors(slam, roles)
    assert len(ended.map.factors) == len(plain.map.factors)
    assert "not used" in ended.notes[-1]
