"""The poses of frames between keyframes, after the keyframes have moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed_keyframes import SIZE, small_keyframe

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.global_map.propagated_poses import propagated_poses
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracking_state import FramePose, Tracker

KEYFRAMES = (0, 4, 8)


def _straight(length: float) -> np.ndarray:
    """A straight walk of nine frames, float64 [9, 4, 4], world -> camera: so many metres a frame."""
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, 3] = -length * np.arange(9)[:, None] * (1.0, 0.5, 0.2)
    return poses


def _walked(begins: tuple[int, ...]) -> Slam:
    """A walk of 1 m a frame whose keyframes the adjustment has put 1.5 m a frame apart. The keyframe numbers in
    `begins` begin a submap; the others were tracked against the one before.
    """
    tracked, adjusted = _straight(1.0), _straight(1.5)
    like = small_keyframe(0, np.ones(SIZE))
    keyframes = tuple(
        replace(like, number=number, frame=frame, timestamp=float(frame), pose=adjusted[frame])
        for number, frame in enumerate(KEYFRAMES)
    )
    records = []
    for frame in range(9):
        number = frame // 4
        if frame not in KEYFRAMES:
            relative = tracked[frame] @ rigid.invert(tracked[4 * number])
            records.append(FramePose(frame, float(frame), number, relative, True, 50))
        elif number in begins:
            records.append(FramePose(frame, float(frame), number, np.eye(4), True, 50))
        else:
            arrival = (number - 1, tracked[frame] @ rigid.invert(tracked[frame - 4]))
            records.append(FramePose(frame, float(frame), number, np.eye(4), True, 50, arrival=arrival))
    given = np.array([500.0, 500.0, 320.0, 240.0])
    return Slam(
        map=Map(metric=True, keyframes=keyframes),
        camera=CameraEstimate(intrinsics=given, given=given, sigma=np.full(4, 5.0)),
        tracker=Tracker(frames=tuple(records)),
    )


def test_frames_between_keyframes_share_what_the_adjustment_changed() -> None:
    """Keyframes that are pulled apart evenly take the frames between along; oracle: the straight path through them."""
    _, poses = propagated_poses(_walked(begins=(0,)))
    assert np.allclose(poses, _straight(1.5), atol=1e-12)


def test_a_keyframe_that_begins_a_submap_keeps_its_pose_and_begins_its_own_share() -> None:
    """The frame that a submap begins with stands where its keyframe does, and the frames behind it share what changed
    from there on; those before it, which nothing ties to it, stay as they were tracked. Oracle: the straight paths.
    """
    _, poses = propagated_poses(_walked(begins=(0, 1)))
    assert np.allclose(poses[4:], _straight(1.5)[4:], atol=1e-12)
    assert np.allclose(poses[:4], _straight(1.0)[:4], atol=1e-12)


@pytest.mark.parametrize(
    ("sigma", "metric", "by_two_view", "length"),
    [(0.5, True, False, 1.5), (0.05, True, False, 1.0), (0.05, False, False, 1.5), (0.5, False, True, 1.0)],
)
def test_a_keyframe_that_was_tracked_wrongly_leaves_the_frames_before_it_where_they_are(
    sigma: float, metric: bool, by_two_view: bool, length: float
) -> None:
    """2.3 m between a keyframe as tracked and as adjusted are drift where its tracking left them open, and an error of
    that frame alone where it did not; without depth they are another unit, or a length that was a guess. Oracle: the
    straight paths.
    """
    slam = _walked(begins=(0,)).with_map(metric=metric)
    known = np.diag(np.repeat([sigma, 0.1], 3) ** -2.0)
    arrivals = [record for record in slam.frames if record.arrival is not None]
    factors = tuple(
        MeasuredRelativePose(r.arrival[0], r.reference, r.arrival[1], known, by_two_view) for r in arrivals if r.arrival
    )
    _, poses = propagated_poses(slam.with_map(factors=factors))
    for first in (0, 4):
        step = _straight(length) @ rigid.invert(_straight(length)[0])
        assert np.allclose(poses[first : first + 4] @ rigid.invert(poses[first]), step[:4], atol=1e-12)
