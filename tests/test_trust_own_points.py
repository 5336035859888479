"""Frames against the landmarks that they were placed by, in a map whose depths are right and in one where they are not.

Oracles: the cameras and the depths that the landmarks were projected with.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_keyframe_depth import INTRINSICS, SIZE, keyframe
from vggtgeo.models.rigid_motion import exponential

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.sparse_map.keyframe import Slots
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracker import FramePose, SeenPoints, Tracker
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.own_points import IN_A_ROW, agreeing_landmarks, check_own_points

FRAMES, POINTS = 24, 120
FIRST_OFF = 12


def _told(slam: Slam) -> list[Finding]:
    return check_own_points(slam, frame_poses(slam)[1])


def _glide(noise: float) -> Slam:
    """A camera that glides past things 1 to 1.5 m and 4 to 6 m away, one keyframe and frames with a noise in pixels."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform(8, [SIZE[1] - 8, SIZE[0] - 8], (POINTS, 2))
    near = np.arange(POINTS) % 3 == 0
    inverse = 1 / np.where(near, rng.uniform(1.0, 1.5, POINTS), rng.uniform(4.0, 6.0, POINTS))
    one, unknown = np.ones(POINTS), np.full(POINTS, np.nan)
    first = keyframe(0, np.ones(SIZE), Slots(pixels, inverse, unknown, unknown, one, one))
    world = rigid.unproject(pixels, inverse, first.pose, INTRINSICS)
    records = [FramePose(0, 0.0, 0, np.eye(4), True, POINTS)]
    for row in range(1, FRAMES):
        motion = exponential(np.array([-0.05 * row, 0.002 * row, 0.004 * row, 0.0, 0.003 * row, 0.0]))
        shown = rigid.project(world, motion @ first.pose, INTRINSICS) + rng.normal(0, noise, (POINTS, 2))
        seen = SeenPoints(np.arange(POINTS, dtype=np.int32), shown.astype(np.float32))
        records.append(FramePose(row, row / 10, 0, motion, True, POINTS, seen=seen))
    return Slam(
        map=Map(metric=False, keyframes=(first,), pose_sigma=np.full((1, 2), 0.01)),
        camera=CameraEstimate(intrinsics=INTRINSICS, given=INTRINSICS, sigma=np.full(4, 1.0)),
        tracker=Tracker(frames=tuple(records)),
    )


def _with_wrong_depths(slam: Slam) -> Slam:
    """The same, but what is near lies half as far again in the map: no pose explains near and far."""
    first = slam.keyframes[0]
    inverse = first.points.inverse_depth
    wrong = np.where(inverse > 0.5, inverse / 1.5, inverse)
    return replace(
        slam, map=replace(slam.map, keyframes=(replace(first, points=replace(first.points, inverse_depth=wrong)),))
    )


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_right_map_is_silent_in_any_noise(noise: float) -> None:
    """All but one landmark in ninety, and what a robust fit leaves of that, agree."""
    slam = _glide(noise)
    rows, shares = agreeing_landmarks(slam, frame_poses(slam)[1])
    np.testing.assert_array_equal(rows, np.arange(1, FRAMES))
    assert np.median(shares) > 0.95
    assert _told(slam) == []


@pytest.mark.parametrize("again", [True, False])
def test_picture_that_stands_still_is_one_witness(again: bool) -> None:
    """Ten frames of which each has a quarter of its landmarks elsewhere are told, unless they are one picture, shown
    again and again; oracle: which it is.
    """
    rng, slam = np.random.default_rng(1), _glide(0.5)
    records = list(slam.frames)
    for row in range(FIRST_OFF, FIRST_OFF + 10):
        seen = records[FIRST_OFF if again else row].seen
        assert seen is not None
        if not again or row == FIRST_OFF:
            elsewhere = rng.normal(0, 20, seen.pixels.shape) * (rng.random((POINTS, 1)) < 0.25)
            seen = replace(seen, pixels=(seen.pixels + elsewhere).astype(np.float32))
        records[row] = replace(records[row], relative=records[FIRST_OFF if again else row].relative, seen=seen)
    changed = replace(slam, tracker=replace(slam.tracker, frames=tuple(records)))
    assert len(agreeing_landmarks(changed, frame_poses(changed)[1])[0]) == FRAMES - (10 if again else 1)
    assert len(_told(changed)) == (not again)


def test_map_of_wrong_depths_is_told_where_its_frames_have_moved() -> None:
    """Each frame is placed by the far two thirds, and what is near is elsewhere by more the farther it has moved."""
    (finding,) = _told(_with_wrong_depths(_glide(0.5)))
    assert finding.level == "degraded"
    assert not finding.local
    assert finding.end == FRAMES - 1
    assert finding.start is not None
    assert 1 <= finding.start <= FIRST_OFF
    assert any("were placed are elsewhere" in reason for reason in judge(_with_wrong_depths(_glide(0.5))).reasons)


def test_nothing_is_asked_with_depth_of_few_frames_and_before_the_end() -> None:
    wrong = _with_wrong_depths(_glide(0.5))
    assert _told(replace(wrong, map=replace(wrong.map, metric=True))) == []
    assert _told(replace(wrong, tracker=replace(wrong.tracker, frames=wrong.frames[:IN_A_ROW]))) == []
    assert _told(replace(wrong, map=replace(wrong.map, pose_sigma=None))) == []
