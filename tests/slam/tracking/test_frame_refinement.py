"""Frames between keyframes, placed by the next keyframe, too; oracle: the true motions of a rendered room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from changed import changed
from recorded_run import RecordedRun

from vggtgeo.geometry import rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.geometry.robust import POSE_GATE
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.map import scaled_keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.accumulated_odometry import squared_distance
from vggtgeo.slam.tracking.frame_refinement import (
    against_nearest,
    against_reference,
)
from vggtgeo.slam.tracking.tracking_state import FramePose, scaled_record

AWAY = np.array([0.006, -0.005, 0.004, 0.002, -0.003, 0.001])
"""Metres and radians."""


def between(slam: Slam) -> list[int]:
    """Rows of the frames that are no keyframes."""
    frames = {keyframe.frame for keyframe in slam.keyframes}
    return [row for row, record in enumerate(slam.frames) if record.frame not in frames]


def waiting(run: RecordedRun, slam: Slam, rows: list[int]) -> Slam:
    """The state with these frames waiting for a keyframe, and not placed by any so far."""
    frames = tuple(replace(record, second=None) for record in slam.frames)
    return changed(slam, "tracker", frames=frames, between=tuple((row, view(run, slam, row)) for row in rows))


def view(run: RecordedRun, slam: Slam, row: int) -> RgbdView:
    frame = run.frames[slam.frames[row].frame]
    return RgbdView.of(frame.image, Roles().tracking_depth(frame.depth), slam.intrinsics)


def moved(slam: Slam, rows: list[int], away: np.ndarray, sigma: float) -> Slam:
    """The state with some frames off by `away`, every second one to the other side, and said to be known to `sigma`."""
    frames = list(slam.frames)
    for number, row in enumerate(rows):
        record, sign = frames[row], (-1) ** number
        quality = replace(record.quality, sigma_translation=sigma, sigma_rotation=sigma / 2)
        frames[row] = replace(record, relative=exponential(sign * away) @ record.relative, quality=quality)
    return changed(slam, "tracker", frames=tuple(frames))


def off(run: RecordedRun, slam: Slam, rows: list[int]) -> np.ndarray:
    """Metres by which the camera of each frame is off, seen from its keyframe."""
    poses, errors = frame_poses(slam)[1], []
    for row in rows:
        keyframe = slam.keyframes[slam.frames[row].reference]
        relative = poses[row] @ rigid.invert(keyframe.pose)
        true = run.sequence.pose(slam.frames[row].frame) @ rigid.invert(run.sequence.pose(keyframe.frame))
        errors.append(np.linalg.norm(rigid.centre(relative) - rigid.centre(true)))
    return np.array(errors)


def test_frames_that_stand_aside_come_back(run: RecordedRun) -> None:
    """Frames 9 mm aside are brought back to less than half of that by the next keyframe, and keyframes are left alone;
    oracle: the renderer's poses.
    """
    slam, number = run.slam, run.slam.tracker.reference[0]
    rows = [row for row in between(run.slam) if run.slam.frames[row].reference == number - 1]
    wrong = moved(waiting(run, slam, rows), rows, AWAY, 0.02)
    found = replace(wrong, tracker=against_reference(wrong.map, wrong.tracker))
    before, after = off(run, wrong, rows), off(run, found, rows)
    assert len(before)
    assert before.min() > 0.005
    assert after.max() < 0.5 * before.max(), (before, after)
    others = sorted({*range(len(slam.frames))} - {*between(slam)})
    np.testing.assert_allclose(frame_poses(found)[1][others], frame_poses(wrong)[1][others], atol=1e-12)
    assert not found.tracker.between


def test_a_run_places_its_frames_by_the_keyframe_after_them(run: RecordedRun) -> None:
    """All frames that a later keyframe follows were placed by it; oracle: the order of the run."""
    placed = [row for row in between(run.slam) if run.slam.frames[row].reference < run.slam.tracker.reference[0]]
    assert placed
    for row in placed:
        record = run.slam.frames[row]
        assert record.second.keyframe == record.reference + 1


def test_frames_that_no_keyframe_follows_are_placed_by_an_earlier_one(run: RecordedRun) -> None:
    """Frames of the newest keyframe are placed by the one before it, in which they stand aside; oracle: true poses."""
    slam, number = run.slam, run.slam.tracker.reference[0]
    row = between(slam)[-1]
    own = replace(slam.frames[row], reference=number, relative=np.eye(4))
    true = run.sequence.pose(own.frame) @ rigid.invert(run.sequence.pose(slam.keyframes[number].frame))
    frames = (*slam.frames[:row], replace(own, relative=true), *slam.frames[row + 1 :])
    wrong = moved(waiting(run, changed(slam, "tracker", frames=frames), [row]), [row], AWAY, 0.02)
    found = replace(wrong, tracker=against_nearest(wrong.map, wrong.tracker, wrong.intrinsics, Roles()))
    assert found.frames[row].second.keyframe != number
    assert off(run, found, [row])[0] < 0.6 * off(run, wrong, [row])[0]


def test_poses_that_contradict_each_other_are_told_by_what_both_know(run: RecordedRun) -> None:
    """A frame that contradicts its second motion stays. Oracle: the squared distance of two poses, in the noise of both
    together, as it was made.
    """
    noise = (0.003**2 + 0.004**2) * np.eye(6)[None]
    away = rigid.moved(np.eye(4)[None], np.array([[1.0, -1, 0, 0, 1, 0]]) / np.sqrt(3) * 0.005 * np.sqrt(29.0))
    assert squared_distance(away, np.eye(4)[None], noise) == pytest.approx(29.0)
    assert pytest.approx(27.86, abs=0.01) == POSE_GATE
    rows = [row for row, record in enumerate(run.slam.frames) if record.second is not None]
    contradicted = moved(run.slam, rows, 100 * AWAY, 0.001)
    alone = changed(
        contradicted, "tracker", frames=tuple(replace(record, second=None) for record in contradicted.frames)
    )
    np.testing.assert_allclose(frame_poses(contradicted)[1], frame_poses(alone)[1], atol=1e-12)


def test_in_a_larger_world_frames_are_placed_as_before(run: RecordedRun) -> None:
    """Lengths of a map become three times as long, as a submap that joins another one: frames stand where they stood,
    three times as far, and agree with both keyframes as well as they did. Oracle: the poses before.
    """
    slam = run.slam
    assert any(record.second is not None for record in slam.frames)
    scaled = replace(
        slam,
        map=replace(slam.map, keyframes=tuple(scaled_keyframe(keyframe, 3.0) for keyframe in slam.keyframes)),
        tracker=replace(
            slam.tracker, frames=tuple(_known_as_well(scaled_record(record, 3.0), 3.0) for record in slam.frames)
        ),
    )
    before, after = frame_poses(slam)[1], frame_poses(scaled)[1]
    np.testing.assert_allclose(after[:, :3, 3], 3 * before[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(after[:, :3, :3], before[:, :3, :3], atol=1e-9)


def _known_as_well(record: FramePose, ratio: float) -> FramePose:
    quality = replace(record.quality, sigma_translation=ratio * record.quality.sigma_translation)
    return replace(record, quality=quality)
