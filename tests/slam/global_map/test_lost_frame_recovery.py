"""Frames that tracking has lost, tried again at the end. Exact truth: the renderer's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recorded_run import ROLES, SETTINGS, run_over
from vggtgeo.models.classical import NoDepth

from vggtgeo.datasets.frame import Frame
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.slam.global_map.lost_frame_recovery import place_lost_without_depth
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracking_state import MAX_UNPLACED, FramePose, UnplacedFrame
from vggtgeo.slam.tracking.waiting_frames import place_waiting

SIZE = (320, 240)
FREE_ROLES = replace(ROLES, depth=NoDepth())
KNOWN = 12
"""Frames of the walk that are tracked; the others are lost."""


@pytest.fixture(scope="module")
def lost(room: tuple[list[Frame], Camera, Trajectory]) -> Slam:
    """A map of the first frames whose scale is free, and all later frames without a pose."""
    frames, camera, _ = room
    slam = run_over(frames[:KNOWN], camera)
    last = slam.frames[-1]
    later = [replace(last, frame=frame.index, timestamp=frame.timestamp, tracked=False) for frame in frames[KNOWN:]]
    unplaced = tuple(_lost(frame) for frame in frames[KNOWN:])
    return slam.with_map(metric=False).with_tracker(frames=(*slam.frames, *later), unplaced=unplaced)


def _lost(frame: Frame) -> UnplacedFrame:
    return UnplacedFrame(frame.index, frame.timestamp, frame.image, ROLES.points.describe(frame.image))


def test_lost_frames_are_placed_by_keyframes_made_of_them(
    lost: Slam, room: tuple[list[Frame], Camera, Trajectory]
) -> None:
    """The camera leaves what the map shows; frames that see its border become keyframes, which place those beyond.
    Oracle: the renderer's poses.
    """
    found = place_lost_without_depth(lost, FREE_ROLES, SETTINGS)
    assert all(record.tracked for record in found.frames), [r.frame for r in found.frames if not r.tracked]
    assert len(found.keyframes) > len(lost.keyframes)
    assert not found.tracker.unplaced
    error = evaluate_trajectory(frame_trajectory(found), room[2]).se3.statistics.rmse
    assert error < 0.03, f"{100 * error:.1f} cm"


def test_keyframes_are_listed_by_time(lost: Slam) -> None:
    """A keyframe that was made at the end of a frame in between is listed where it was seen. Oracle: the times."""
    first, second, *others = lost.keyframes
    swapped = (replace(first, timestamp=second.timestamp), replace(second, timestamp=first.timestamp), *others)
    listed = keyframe_trajectory(lost.with_map(keyframes=swapped))
    assert listed.timestamps.tolist() == sorted(keyframe.timestamp for keyframe in swapped)


def test_frames_of_another_place_stay_lost(lost: Slam, room: tuple[list[Frame], Camera, Trajectory]) -> None:
    """Frames that show nothing of the map (a room that is the other way round) get no pose, and the map stays as it
    is.
    """
    mirrored = [replace(frame, image=frame.image[:, ::-1].copy()) for frame in room[0][:3]]
    elsewhere = tuple(
        replace(_lost(frame), frame=KNOWN + row, timestamp=(KNOWN + row) / 10) for row, frame in enumerate(mirrored)
    )
    found = place_lost_without_depth(lost.with_tracker(unplaced=elsewhere), FREE_ROLES, SETTINGS)
    assert found.map is lost.map
    assert not any(record.tracked for record in found.frames[KNOWN:])


def test_frames_that_stay_without_a_pose_are_kept(lost: Slam) -> None:
    """Of the lost frames, those that the next tracked one does not place are kept, and not more than fit."""
    blank = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    unknown = tuple(
        UnplacedFrame(100 + row, 100.0 + row, blank, ROLES.points.describe(blank)) for row in range(MAX_UNPLACED + 5)
    )
    tracked = FramePose(300, 300.0, 0, np.eye(4), True, 50)
    tracker = replace(lost.tracker, frames=(*lost.frames, tracked), waiting=unknown, unplaced=())
    kept = place_waiting(lost.map, tracker, lost.intrinsics, FREE_ROLES)
    assert not kept.waiting
    assert [one.frame for one in kept.unplaced] == [one.frame for one in unknown[-MAX_UNPLACED:]]
