"""Frames that points alone placed, by the finished map; oracles: the cameras that the points were projected with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed_keyframes import INTRINSICS, SIZE, small_keyframe
from vggtgeo.models.roles import GeometryResult, PoseGuess

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.geometry.robust import FEW
from vggtgeo.slam.camera.camera_estimate import CameraEstimate, Readout
from vggtgeo.slam.camera.rolling_shutter import image_shift
from vggtgeo.slam.global_map import frame_poses as module
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.global_map.pose_uncertainty import SHARED_ERRORS
from vggtgeo.slam.global_map.propagated_poses import frame_motions, propagated_poses
from vggtgeo.slam.sparse_map.keyframe import Slots
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.flow_tracking import MAX_KEPT, Located
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality
from vggtgeo.slam.tracking.tracking_state import FramePose, SeenPoints, Tracker

POINTS = 60
MOVED = np.array([0.05, -0.02, 0.03, 0.01, 0.02, -0.01])
"""Of the second frame from the keyframe, and what tracking had it off by: metres and radians."""
AWAY = np.array([0.02, 0.01, -0.02, 0.003, -0.004, 0.002])


def walked(rng: np.random.Generator, points: int = POINTS) -> tuple[Slam, np.ndarray]:
    """A keyframe with points 2 to 4 m away and three frames 0.1 s apart: it, one that was tracked wrongly and kept what
    it shows, and one that nothing is known of. With the true pose of the second, world -> camera.
    """
    pixels = rng.uniform(8, [SIZE[1] - 8, SIZE[0] - 8], (points, 2))
    inverse, none = 1 / rng.uniform(2.0, 4.0, points), np.zeros(points)
    first = small_keyframe(
        0, np.ones(SIZE), Slots(pixels, inverse, inverse, none + 0.01, none + 1, none + 1, none + np.nan)
    )
    first = replace(first, pose=exponential(np.array([0.3, 0.1, -0.2, 0.1, 0.2, 0.3])))
    motion = exponential(MOVED)
    pose = motion @ first.pose
    there = rigid.project(rigid.unproject(pixels, inverse, first.pose, INTRINSICS), pose, INTRINSICS)
    seen = SeenPoints(np.arange(points, dtype=np.int32), there.astype(np.float32))
    unsure = TrackingQuality(sigma_translation=0.3, sigma_rotation=0.1)
    records = (
        FramePose(0, 0.0, 0, np.eye(4), True, points),
        FramePose(1, 0.1, 0, exponential(AWAY) @ motion, True, points, unsure, seen=seen),
        FramePose(2, 0.2, 0, motion @ motion, True, points),
    )
    sparse_map = Map(False, keyframes=(first,), pose_sigma=np.full((1, 2), 0.01))
    camera = CameraEstimate(INTRINSICS, INTRINSICS, np.full(4, 1.0))
    return Slam(sparse_map, camera, Tracker(records)), pose


def with_second(slam: Slam, **values: object) -> Slam:
    """The state with another second frame."""
    return slam.with_tracker(frames=(slam.frames[0], replace(slam.frames[1], **values), slam.frames[2]))


def off(slam: Slam, pose: np.ndarray) -> float:
    """Metres by which the second frame's camera is off."""
    return float(np.linalg.norm(rigid.centre(frame_poses(slam)[1][1]) - rigid.centre(pose)))


def test_a_frame_goes_to_where_the_finished_map_explains_what_it_shows() -> None:
    """Over 2 cm aside, with 0.05 px of noise and a sixth of the matches wrong by 3 to 5 px, it comes to within 3 mm;
    the others stay to the bit.
    """
    rng = np.random.default_rng(0)
    slam, pose = walked(rng)
    seen = slam.frames[1].seen
    noise = rng.normal(0, 0.05, (POINTS, 2))
    noise[::6] += rng.uniform(3, 5, (POINTS // 6, 2))
    slam = with_second(slam, seen=replace(seen, pixels=seen.pixels + noise.astype(np.float32)))
    times, poses = frame_poses(slam)
    before = propagated_poses(slam)[1]
    assert np.linalg.norm(rigid.centre(before[1]) - rigid.centre(pose)) > 0.02
    assert off(slam, pose) < 0.003
    np.testing.assert_array_equal(poses[[0, 2]], before[[0, 2]])
    np.testing.assert_array_equal(times, [0.0, 0.1, 0.2])


def test_without_depth_what_tracking_knew_counts_less() -> None:
    """Tracked 2 cm aside, sure to 2 cm by matches that share the errors of old depths: six times less is left of that
    than where depths were measured; oracle: the true pose, which the points show without noise.
    """
    slam, pose = walked(np.random.default_rng(0))
    slam = with_second(slam, quality=TrackingQuality(sigma_translation=0.02, sigma_rotation=0.01))
    left, measured = off(slam, pose), off(slam.with_map(metric=True), pose)
    assert 4 * left < measured


def test_what_the_adjustment_did_to_points_and_keyframe_counts() -> None:
    """The keyframe moved and its points nearer: the frame is placed by them as they are; oracle: the same world, seen
    from where the keyframe is now.
    """
    slam, pose = walked(np.random.default_rng(1))
    first, world = slam.keyframes[0], exponential(np.array([0.5, 0, 0, 0, 0.4, 0]))
    points = replace(first.points, inverse_depth=2 * first.points.inverse_depth)
    half = pose @ rigid.invert(first.pose)
    half[:3, 3] /= 2
    slam = slam.with_map(keyframes=(replace(first, pose=first.pose @ world, points=points),))
    assert off(slam, half @ first.pose @ world) < 1e-3


def test_without_enough_points_a_pose_stays() -> None:
    """One point too few, points whose depth is gone, or that came to lie behind the camera, a frame without a pose, a
    map that is not finished; and nothing known of its tracking: as it was carried, to the bit.
    """
    slam = with_second(walked(np.random.default_rng(2), FEW)[0], quality=TrackingQuality())
    few = slam.frames[1].seen
    first = slam.keyframes[0]
    gone = replace(first, points=replace(first.points, inverse_depth=np.full(FEW, np.nan)))
    for wrong in (
        with_second(slam, seen=SeenPoints(few.slots[1:], few.pixels[1:])),
        slam.with_map(keyframes=(gone,)),
        with_second(slam, relative=exponential(np.array([0, 0, -9.0, 0, 0, 0]))),
        with_second(slam, tracked=False),
        slam.with_map(pose_sigma=None),
    ):
        np.testing.assert_array_equal(frame_poses(wrong)[1], propagated_poses(wrong)[1])
    assert not np.array_equal(frame_poses(slam)[1], propagated_poses(slam)[1])


@pytest.mark.parametrize("columns", [False, True])
def test_a_rolling_shutter_is_taken_out_of_what_a_frame_shows(columns: bool) -> None:
    """Images that are read within 90 ms: pixels of frame and keyframe as they were read place it where those of one
    moment would; oracle: the pose that both were projected with.
    """
    slam, pose = walked(np.random.default_rng(4))
    slam = with_second(slam, relative=pose @ rigid.invert(slam.keyframes[0].pose))  # its motion is known from that
    readout = Readout(0.09, columns, 1.0)
    first, seen = slam.keyframes[0], slam.frames[1].seen
    inverse = first.points.inverse_depth
    world = rigid.unproject(first.points.pixels, inverse, first.pose, INTRINSICS)
    there = 1 / (world @ pose[2, :3] + pose[2, 3])
    motions = frame_motions(slam)

    def read(pixels: np.ndarray, depth: np.ndarray, row: int) -> np.ndarray:
        at = pixels.astype(np.float64)[None]
        return pixels + readout.seconds * image_shift(at, depth[None], motions[[row]], INTRINSICS, SIZE, columns)[0]

    points = replace(first.points, pixels=read(first.points.pixels, inverse, 0))
    seen = replace(seen, pixels=read(seen.pixels, there, 1).astype(np.float32))
    rolling = with_second(slam.with_map(keyframes=(replace(first, points=points),)), seen=seen)
    assert off(rolling, pose) > 0.001
    assert off(rolling.with_camera(readout=readout), pose) < 0.2 * off(rolling, pose)


def test_a_frame_keeps_some_of_its_matches() -> None:
    """At most `MAX_KEPT`, of those that agree with its pose; oracle: the inliers."""
    inliers = np.random.default_rng(5).random(500) < 0.6
    slots, pixels = np.arange(500) + 7, np.random.default_rng(6).uniform(0, 100, (500, 2))
    guess = PoseGuess(np.eye(4), inliers, 0.3, GeometryResult.SUCCESS)
    seen = Located(guess, 500, np.zeros((500, 3)), 2.0, slots, pixels).seen
    assert len(seen.slots) == len(set(seen.slots.tolist())) == MAX_KEPT
    assert inliers[seen.slots - 7].all()
    np.testing.assert_allclose(seen.pixels, pixels[seen.slots - 7], atol=1e-4)
    few = Located(replace(guess, inliers=np.zeros(500, bool)), 500, np.zeros((500, 3)), 2.0, slots, pixels).seen
    assert len(few.slots) == 0
    assert Located(guess, 500, np.zeros((500, 3)), 2.0).seen is None


def test_what_points_leave_open_is_smoothed_without_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame that is neither a keyframe's nor unknown is free, with the information of its points at their noise;
    with measured depth nothing is smoothed. Oracle: the noise that was drawn, and dense algebra.
    """
    rng, asked = np.random.default_rng(4), []
    slam, _ = walked(rng)
    seen = slam.frames[1].seen
    noisy = seen.pixels + rng.normal(0, 0.3, seen.pixels.shape).astype(np.float32)
    slam = with_second(slam, seen=replace(seen, pixels=noisy))
    monkeypatch.setattr(module, "smoothed", lambda *given: asked.append(given) or given[1])
    frame_poses(slam)
    ((_, poses, information, free, label),) = asked
    assert free.tolist() == [False, True, False]
    assert label.tolist() == [0, 0, 0]
    first = slam.keyframes[0]
    points = rigid.unproject(first.points.pixels, first.points.inverse_depth, first.pose, INTRINSICS)
    rows = np.concatenate(pinhole.projection_rows(points @ poses[1, :3, :3].T + poses[1, :3, 3], INTRINSICS), 1)
    expected = rows @ rows.T / (SHARED_ERRORS * 0.3**2)
    # Robust weights of a Gaussian take a share of it.
    assert 0.5 < np.trace(information[1]) / np.trace(expected) < 1.1
    frame_poses(slam.with_map(metric=True))
    assert len(asked) == 1
