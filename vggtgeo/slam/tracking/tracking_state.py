"""State of tracking: the pose of every frame relative to a keyframe, and the current velocity."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from vggtgeo.models.roles import Features
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.sparse_map.map import Map, longer, scaled_information
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality

MAX_UNPLACED = 90
"""Frames without a pose that are kept, to be tracked once there is a map or at the end. Each takes half a megabyte at
480 x 270, its image and descriptors."""


@dataclass(frozen=True, eq=False)
class SecondMotion:
    """Motion from a second keyframe to a frame, see `frame_refinement.py`. relative: float64 [4, 4], camera -> camera.
    information: float64 [6, 6] over its left tangent, translation first, systematic errors included.
    """

    keyframe: int
    relative: np.ndarray
    information: np.ndarray


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Key points of a keyframe matched in a frame, see `frame_poses.py`. slots: int32 [m], in `Keyframe.points`.
    pixels: float32 [m, 2], in the frame.
    """

    slots: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class FramePose:
    """Pose of one frame relative to a keyframe, so that it follows when the keyframe is adjusted.

    relative: float64 [4, 4], reference camera -> this camera. tracked: False where tracking failed; `relative` is then
    that of the last frame. quality: of the tracking, with the uncertainty of the pose.
    """

    frame: int
    timestamp: float
    reference: int
    relative: np.ndarray
    tracked: bool
    inliers: int
    quality: TrackingQuality = field(default_factory=TrackingQuality)
    arrival: tuple[int, np.ndarray] | None = None
    """Of a frame that became a keyframe: the earlier keyframe it was tracked against, and its pose relative to that
    one as tracked, before any adjustment."""
    second: SecondMotion | None = None
    seen: SeenPoints | None = None
    """Points of its keyframe, where its pose came from points alone."""


@dataclass(frozen=True, eq=False)
class UnplacedFrame:
    """A frame without a pose, before initialisation or while tracking was lost. It is tracked once a map exists."""

    frame: int
    timestamp: float
    image: np.ndarray
    features: Features
    depth: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Tracker:
    """The state of tracking.

    Fields:
        frames: Every frame's pose relative to its keyframe.
        velocity: Last motion from frame to frame, float64 [4, 4], camera -> camera.
        reference: Number of the keyframe that frames are tracked against, and its view for the alignment.
        lost: Frames since tracking was lost, 0 while it goes well.
        waiting: Frames without a pose so far.
        unplaced: Frames that stayed without a pose in a map of free scale, the last `MAX_UNPLACED` of them: the end
            tries them again (`global_map/lost_frame_recovery.py`).
        between: Rows of the last frames, and their views, that wait for the next keyframe (`frame_refinement.py`).

    """

    frames: tuple[FramePose, ...] = ()
    velocity: np.ndarray = field(default_factory=lambda: np.eye(4))
    reference: tuple[int, RgbdView | None] | None = None
    lost: int = 0
    waiting: tuple[UnplacedFrame, ...] = ()
    unplaced: tuple[UnplacedFrame, ...] = ()
    between: tuple[tuple[int, RgbdView], ...] = ()


def given_up(tracker: Tracker, frames: Iterable[UnplacedFrame]) -> tuple[UnplacedFrame, ...]:
    """Append frames to the unplaced ones, of which the last `MAX_UNPLACED` are kept."""
    return (*tracker.unplaced, *frames)[-MAX_UNPLACED:]


def frame_pose(known: Map, record: FramePose) -> np.ndarray:
    """Return world -> camera of a frame, float64 [4, 4], by the current estimate of its keyframe."""
    return record.relative @ known.keyframes[record.reference].pose


def scaled_record(record: FramePose, ratio: float) -> FramePose:
    """Return the record of a frame whose keyframe was scaled, see `scaled_keyframe` in `sparse_map/map.py`."""
    arrival = None if record.arrival is None else (record.arrival[0], longer(record.arrival[1], ratio))
    second = record.second
    if second is not None:
        # Information of a translation is 1 / length^2, so it is scaled too.
        information = scaled_information(second.information, ratio)
        second = replace(second, relative=longer(second.relative, ratio), information=information)
    return replace(record, relative=longer(record.relative, ratio), arrival=arrival, second=second)
