"""Placement of lost frames without depth, at the end of a run: against every keyframe, also later ones.

A frame that sees much of what no keyframe shows becomes a keyframe; its matches give depth
to points that place further frames. This is repeated until no frame is placed any more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.slam.keyframe_decision import needs_keyframe
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import make_keyframe
from vggtgeo.slam.sparse_map.map import submap_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.map_points import in_view
from vggtgeo.slam.tracking.relocalisation import record_of, relocalise
from vggtgeo.slam.tracking.track import FrameData, MotionPrior, Track, TrackingInput, tie_to, track, track_by_map
from vggtgeo.slam.tracking.tracker import FramePose, UnplacedFrame, frame_pose
from vggtgeo.slam.window.sliding_window import Window
from vggtgeo.slam.window_steps import adjust_window, insert_keyframe


def place_lost_without_depth(slam: Slam, roles: Roles, settings: SlamSettings) -> Slam:
    """Place the frames that tracking has lost, as far as all keyframes allow."""
    if slam.metric or not slam.keyframes:
        return slam
    lost = {record.frame for record in slam.frames if not record.tracked}
    waiting = {one.frame: one for one in (*slam.tracker.unplaced, *slam.tracker.waiting) if one.frame in lost}
    placed, keyframes = 0, -1
    while waiting and keyframes < len(slam.keyframes):
        keyframes = len(slam.keyframes)
        for number in _nearest_first(slam, waiting):
            found = _found(slam, waiting[number], roles)
            if found is not None:
                slam = _with_frame(slam, waiting.pop(number), found, roles, settings)
                placed += 1
    if not placed:
        return slam
    note = f"{placed} frames that tracking had lost are placed at the end"
    return replace(slam, notes=(*slam.notes, note))


def _nearest_first(slam: Slam, waiting: dict[int, UnplacedFrame]) -> list[int]:
    """Sort the frames by the distance in time to the next frame with a pose."""
    placed = np.array([record.frame for record in slam.frames if record.tracked])
    return sorted(waiting, key=lambda frame: int(np.abs(placed - frame).min(initial=np.iinfo(int).max)))


def _data(waiting: UnplacedFrame) -> FrameData:
    frame = Frame(waiting.frame, waiting.timestamp, waiting.image, None, "")
    return FrameData(frame, Description.of(waiting.features), None)


def _found(slam: Slam, waiting: UnplacedFrame, roles: Roles) -> Track | None:
    """Track a frame by a keyframe that looks like it, or near the frame that is next to it in time."""
    given = TrackingInput(_data(waiting), slam.intrinsics, roles)
    certain = relocalise(given, slam.keyframes, slam.tracker)
    if certain is not None:
        return certain
    beside = _beside(slam, waiting)
    if beside is None:
        return None
    pose = frame_pose(slam.map, beside)
    prior = MotionPrior(pose, np.eye(4), waited=abs(beside.frame - waiting.frame) - 1)
    given = replace(given, prior=prior)
    label = submap_of(slam.map)
    own = [keyframe for keyframe in slam.keyframes if label[keyframe.number] == label[beside.reference]]
    near = in_view(own, pose)
    tried = [track(given, keyframe, None) for keyframe in near]
    tried += [track_by_map(given, own, keyframe, None) for keyframe in near[:1]]
    accepted = [found for found in tried if found.accepted]
    return max(accepted, key=lambda found: found.evidence.inliers, default=None)


def _beside(slam: Slam, waiting: UnplacedFrame) -> FramePose | None:
    """Return the frame with a pose that is nearest in time."""
    placed = [record for record in slam.frames if record.tracked]
    return min(placed, key=lambda record: abs(record.timestamp - waiting.timestamp), default=None)


def _with_frame(slam: Slam, waiting: UnplacedFrame, found: Track, roles: Roles, settings: SlamSettings) -> Slam:
    """Add the frame's pose, and the frame as a keyframe if it sees what others do not."""
    record = record_of(_data(waiting).frame, found)
    if needs_keyframe(slam, found.pose, found.keyframe, found.evidence.inliers, settings.keyframes):
        slam, record = _with_keyframe(slam, waiting, found, record, roles, settings)
    frames = tuple(record if other.frame == waiting.frame else other for other in slam.frames)
    left = tuple(other for other in slam.tracker.unplaced if other.frame != waiting.frame)
    return replace(slam, tracker=replace(slam.tracker, frames=frames, unplaced=left))


def _with_keyframe(
    slam: Slam, waiting: UnplacedFrame, found: Track, record: FramePose, roles: Roles, settings: SlamSettings
) -> tuple[Slam, FramePose]:
    """Add a keyframe, adjusted in a window of those nearest in time, which are fixed."""
    number, data, label = len(slam.keyframes), _data(waiting), submap_of(slam.map)
    keyframe = make_keyframe(number, data.frame, found.pose, data.description, roles, settings, slam.intrinsics)
    others = [other for other in slam.keyframes if label[other.number] == label[found.keyframe.number]]
    others.sort(key=lambda other: (other is not found.keyframe, abs(other.timestamp - waiting.timestamp)))
    members = tuple(sorted(other.number for other in others[: settings.window.size - 1]))
    before = slam.window
    slam = replace(slam, window=Window(members=members, held=members))
    slam = insert_keyframe(slam, keyframe, roles, settings)
    slam = replace(slam, map=replace(slam.map, factors=(*slam.map.factors, tie_to(found, number))))
    slam = replace(adjust_window(slam, settings), window=before)
    arrival = found.keyframe.number, found.relative
    return slam, replace(record, reference=number, relative=np.eye(4), arrival=arrival, seen=None)
