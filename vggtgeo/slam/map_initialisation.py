"""Initialisation without depth in the first keyframe: from a later frame with depth, or from two views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.models.classical import NoDepth
from vggtgeo.models.roles import Features, GeometryResult, PointMatches, StartGuess
from vggtgeo.slam.local_mapping import adjust_window, insert_keyframe
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe, make_keyframe
from vggtgeo.slam.sparse_map.map import NOMINAL_DEPTH, longer
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.frame_tracking import FrameData, TrackingInput, record_of, track
from vggtgeo.slam.tracking.tracking_state import MAX_UNPLACED, FramePose, UnplacedFrame, given_up
from vggtgeo.slam.window.sliding_window import scale_anchor

MIN_SHARED = 100
"""Matches that a lost frame must share with the current one to start the map instead of the first keyframe:
`TwoViewStart` needs 60 inliers. The initialiser of ORB-SLAM (Mur-Artal, Montiel, Tardos, 2015) changes its reference
below the same number."""


def without_depth(roles: Roles) -> Roles:
    """Return the roles without metric depth, which would contradict the scale of a map that was started without it."""
    return replace(roles, depth=NoDepth()) if roles.metric else roles


def begin_again_with_depth(
    slam: Slam, frame: Frame, features: Features, roles: Roles, settings: SlamSettings
) -> Slam | None:
    """Return the state of a map that starts at this frame instead of the first keyframe, whose depth is unknown.

    None if this frame has depth at fewer than `min_inliers` key points.
    """
    depth = roles.depth.estimate(frame.image, frame.depth, tuple(slam.intrinsics))
    if not np.any(np.isfinite(depth.depth)):
        return None
    blind, description = slam.keyframes[-1], Description.of(features)
    keyframe = make_keyframe(blind.number, frame, blind.pose, description, roles, settings, slam.intrinsics)
    if np.count_nonzero(np.isfinite(keyframe.points.inverse_depth)) < settings.keyframes.min_inliers:
        return None
    note = f"the depth of frame {blind.frame} is not known; the map begins at frame {frame.index} ({frame.name})"
    return _with_lost_frames(_begun_with(slam, keyframe).with_notes(note), keyframe, roles)


def start_without_depth(slam: Slam, frame: Frame, features: Features, roles: Roles, settings: SlamSettings) -> Slam:
    """Try to start a map without metric depth from the first keyframe and this frame; until then the frame is lost.

    A first keyframe that shares nothing with this frame is replaced: a video may start at a wall, or turn away before
    it moves.
    """
    first, matches, guess = _two_views(slam, frame, features, roles)
    if guess.result not in (GeometryResult.SUCCESS, GeometryResult.LOW_PARALLAX, GeometryResult.AMBIGUOUS):
        later = _later_first(slam, features, roles, settings)
        if later is not None:
            slam = later
            first, matches, guess = _two_views(slam, frame, features, roles)
    if guess.result is not GeometryResult.SUCCESS:
        lost = (*slam.tracker.waiting, UnplacedFrame(frame.index, frame.timestamp, frame.image, features))
        record = FramePose(frame.index, frame.timestamp, first.number, np.eye(4), False, 0)
        return slam.with_tracker(waiting=lost[-MAX_UNPLACED:], frames=(*slam.frames, record))
    if slam.metric:
        slam, roles = slam.with_map(metric=False), without_depth(roles)
        slam = slam.with_notes(
            f"neither frame {first.frame} nor frame {frame.index} has metric depth: "
            "the scale is free from here on, and later depth is not used"
        )
    scale = NOMINAL_DEPTH / float(np.median(guess.points[guess.inliers, 2]))
    inverse = np.full(len(first.features), np.nan)
    inverse[matches.index_i[guess.inliers]] = 1.0 / (scale * guess.points[guess.inliers, 2])
    first = replace(first, points=replace(first.points, inverse_depth=inverse))
    slam = slam.with_map(keyframes=(*slam.keyframes[:-1], first))
    number, pose = len(slam.keyframes), longer(guess.pose, scale) @ first.pose
    second = make_keyframe(number, frame, pose, Description.of(features), roles, settings, slam.intrinsics)
    slam = insert_keyframe(slam, second, roles, settings)
    slam = adjust_window(slam.with_factors(scale_anchor(slam.map, slam.window.members)), settings)
    first, second = slam.keyframes[first.number], slam.keyframes[number]
    slam = _with_lost_frames(slam, first, roles)
    inliers = int(np.count_nonzero(guess.inliers))
    # The frames between were placed in the map of this moment: what becomes of it later is shared out over them.
    arrival = (first.number, second.pose @ rigid.invert(first.pose))
    record = FramePose(frame.index, frame.timestamp, number, np.eye(4), True, inliers, arrival=arrival)
    return slam.with_tracker(frames=(*slam.frames, record))


def _two_views(slam: Slam, frame: Frame, features: Features, roles: Roles) -> tuple[Keyframe, PointMatches, StartGuess]:
    """Return the first keyframe, its matches with the frame, and the estimated motion and structure of both."""
    first = slam.keyframes[-1]
    matches = roles.points.match(first.features, features)
    guess = roles.geometry.start(matches.pixels_i, matches.pixels_j, slam.intrinsics, (first.image, frame.image))
    return first, matches, guess


def _later_first(slam: Slam, features: Features, roles: Roles, settings: SlamSettings) -> Slam | None:
    """Return the state whose map will start at the oldest lost frame with enough matches with the current one.

    All frames after it must have as many. None if the last one has not: the current one may be blurred or dark.
    """
    chosen, old = None, slam.keyframes[-1]
    for lost in reversed(slam.tracker.waiting):
        if lost.frame < old.frame or len(roles.points.match(lost.features, features)) < MIN_SHARED:
            break
        chosen = lost
    if chosen is None:
        return None
    frame, description = _frame(chosen), Description.of(chosen.features)
    keyframe = make_keyframe(old.number, frame, old.pose, description, roles, settings, slam.intrinsics)
    return _begun_with(slam, keyframe)


def _begun_with(slam: Slam, keyframe: Keyframe) -> Slam:
    """Return the state whose map begins with this keyframe instead of the first one, whose frame is lost."""
    old, records = slam.keyframes[-1], {record.frame: record for record in slam.frames}
    records[old.frame] = replace(records[old.frame], tracked=False, inliers=0)
    records[keyframe.frame] = FramePose(
        keyframe.frame, keyframe.timestamp, keyframe.number, np.eye(4), True, len(keyframe.features)
    )
    others = (lost for lost in slam.tracker.waiting if lost.frame != keyframe.frame)
    lost = (UnplacedFrame(old.frame, old.timestamp, old.image, old.features), *others)
    begun = slam.with_map(keyframes=(*slam.keyframes[:-1], keyframe))
    return begun.with_tracker(frames=tuple(records.values()), waiting=lost)


def _with_lost_frames(slam: Slam, first: Keyframe, roles: Roles) -> Slam:
    """Track the lost frames in the new map, and keep the accepted poses."""
    placed = {}
    for lost in slam.tracker.waiting:
        data = FrameData(_frame(lost), Description.of(lost.features), None)
        found = track(TrackingInput(data, slam.intrinsics, roles), first, None)
        if found.accepted:
            placed[lost.frame] = record_of(data.frame, found)
    frames = tuple(placed.get(record.frame, record) for record in slam.frames)
    left = () if slam.metric else (lost for lost in slam.tracker.waiting if lost.frame not in placed)
    return slam.with_tracker(frames=frames, waiting=(), unplaced=given_up(slam.tracker, left))


def _frame(lost: UnplacedFrame) -> Frame:
    return Frame(lost.frame, lost.timestamp, lost.image, lost.depth, "")
