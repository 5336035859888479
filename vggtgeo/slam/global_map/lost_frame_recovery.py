"""Placement of lost frames without depth, at the end of a run: against every keyframe, also later ones.

A frame that sees much of what no keyframe shows becomes a keyframe; its matches give depth to points that place further
frames. This is repeated until no frame is placed any more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.slam.keyframe_decision import needs_keyframe
from vggtgeo.slam.local_mapping import adjust_window, insert_keyframe
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import make_keyframe
from vggtgeo.slam.sparse_map.map import submap_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.frame_tracking import (
    FrameData,
    MotionPrior,
    TrackedFrame,
    TrackingInput,
    factor_to,
    record_of,
    track,
    track_by_map,
)
from vggtgeo.slam.tracking.local_map_tracking import in_view
from vggtgeo.slam.tracking.relocalisation import relocalise
from vggtgeo.slam.tracking.tracking_state import FramePose, UnplacedFrame
from vggtgeo.slam.window.sliding_window import Window


def place_lost_without_depth(slam: Slam, roles: Roles, settings: SlamSettings) -> Slam:
    """Place the frames that tracking has lost, as far as all keyframes allow."""
    if slam.metric or not slam.keyframes:
        return slam
    unknown = {record.frame for record in slam.frames if not record.tracked}
    lost = {one.frame: one for one in (*slam.tracker.unplaced, *slam.tracker.waiting) if one.frame in unknown}
    placed, keyframes = 0, -1
    while lost and keyframes < len(slam.keyframes):
        keyframes = len(slam.keyframes)
        for number in _nearest_first(slam, lost):
            found = _found(slam, lost[number], roles)
            if found is not None:
                slam = _with_frame(slam, lost.pop(number), found, roles, settings)
                placed += 1
    return slam.with_notes(f"{placed} frames that tracking had lost are placed at the end") if placed else slam


def _nearest_first(slam: Slam, lost: dict[int, UnplacedFrame]) -> list[int]:
    """Sort the frames by the distance in time to the next frame with a pose."""
    placed = np.array([record.frame for record in slam.frames if record.tracked])
    return sorted(lost, key=lambda frame: int(np.abs(placed - frame).min(initial=np.iinfo(int).max)))


def _data(lost: UnplacedFrame) -> FrameData:
    return FrameData(Frame(lost.frame, lost.timestamp, lost.image, None, ""), Description.of(lost.features), None)


def _found(slam: Slam, lost: UnplacedFrame, roles: Roles) -> TrackedFrame | None:
    """Track a frame by a keyframe that looks like it, or near the frame that is next to it in time."""
    given = TrackingInput(_data(lost), slam.intrinsics, roles)
    certain = relocalise(given, slam.keyframes, slam.tracker)
    if certain is not None:
        return certain
    tracked = [record for record in slam.frames if record.tracked]
    beside = min(tracked, key=lambda record: abs(record.timestamp - lost.timestamp), default=None)
    if beside is None:
        return None
    pose = slam.pose(beside)
    given = replace(given, prior=MotionPrior(pose, np.eye(4), waited=abs(beside.frame - lost.frame) - 1))
    label = submap_of(slam.map)
    own = [keyframe for keyframe in slam.keyframes if label[keyframe.number] == label[beside.reference]]
    near = in_view(own, pose)
    tried = [track(given, keyframe, None) for keyframe in near]
    tried += [track_by_map(given, own, keyframe, None) for keyframe in near[:1]]
    accepted = [found for found in tried if found.accepted]
    return max(accepted, key=lambda found: found.quality.inliers, default=None)


def _with_frame(slam: Slam, lost: UnplacedFrame, found: TrackedFrame, roles: Roles, settings: SlamSettings) -> Slam:
    """Add the frame's pose, and the frame as a keyframe if it sees what others do not."""
    record = record_of(_data(lost).frame, found)
    if needs_keyframe(slam, found.pose, found.keyframe, found.quality.inliers, settings.keyframes):
        slam, record = _with_keyframe(slam, lost, found, record, roles, settings)
    frames = tuple(record if other.frame == lost.frame else other for other in slam.frames)
    left = tuple(other for other in slam.tracker.unplaced if other.frame != lost.frame)
    return slam.with_tracker(frames=frames, unplaced=left)


def _with_keyframe(
    slam: Slam, lost: UnplacedFrame, found: TrackedFrame, record: FramePose, roles: Roles, settings: SlamSettings
) -> tuple[Slam, FramePose]:
    """Add a keyframe, adjusted in a window of those nearest in time, which are fixed."""
    number, data, label = len(slam.keyframes), _data(lost), submap_of(slam.map)
    keyframe = make_keyframe(number, data.frame, found.pose, data.description, roles, settings, slam.intrinsics)
    others = [other for other in slam.keyframes if label[other.number] == label[found.keyframe.number]]
    others.sort(key=lambda other: (other is not found.keyframe, abs(other.timestamp - lost.timestamp)))
    members = tuple(sorted(other.number for other in others[: settings.window.size - 1]))
    inserted = replace(slam, window=Window(members=members, fixed=members))
    inserted = insert_keyframe(inserted, keyframe, roles, settings).with_factors(factor_to(found, number))
    adjusted = replace(adjust_window(inserted, settings), window=slam.window)
    arrival = found.keyframe.number, found.relative
    return adjusted, replace(record, reference=number, relative=np.eye(4), arrival=arrival, seen=None)
