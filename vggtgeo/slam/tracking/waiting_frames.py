"""Tracking is lost: frames wait, and are placed once it goes on; after a while a new submap begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.models.roles import Features
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.settings.groups import KeyframeSettings
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.tracking.frame_tracking import MotionPrior, TrackingInput, frame_data, record_of, track, view_of
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality
from vggtgeo.slam.tracking.tracking_state import (
    MAX_UNPLACED,
    FramePose,
    Tracker,
    UnplacedFrame,
    frame_pose,
    given_up,
)

LOST_PATIENCE = 10
"""Number of lost frames with texture after which a new submap begins. Black frames do not count."""


def wait(tracker: Tracker, frame: Frame, features: Features, quality: TrackingQuality) -> Tracker:
    """Let a lost frame wait, recorded without a pose, where the frame before it is; the oldest waiting are dropped."""
    waiting = UnplacedFrame(frame.index, frame.timestamp, frame.image, features, frame.depth)
    last = tracker.frames[-1] if tracker.frames else None
    reference, relative = (0, np.eye(4)) if last is None else (last.reference, last.relative)
    record = FramePose(frame.index, frame.timestamp, reference, relative, False, 0, quality)
    return replace(
        tracker,
        frames=(*tracker.frames, record),
        velocity=tracker.velocity if tracker.lost else np.eye(4),
        lost=tracker.lost + 1,
        waiting=(*tracker.waiting, waiting)[-MAX_UNPLACED:],
    )


def begins_submap(tracker: Tracker, features: Features, settings: KeyframeSettings) -> bool:
    """Return whether a new submap begins at the frame that came to wait last: too many with texture wait with it."""
    shown = sum(len(waiting.features) > settings.min_inliers for waiting in tracker.waiting)
    return not settings.localise_only and shown > LOST_PATIENCE and len(features) > settings.min_inliers


def place_waiting(known: Map, tracker: Tracker, intrinsics: np.ndarray, roles: Roles) -> Tracker:
    """Track the frames that waited while tracking was lost, from the newest back, each predicted from the next."""
    placed: dict[int, FramePose] = {}
    last = tracker.frames[-1]
    pose, step = frame_pose(known, last), np.eye(4)
    keyframe = known.keyframes[last.reference]
    source = view_of(keyframe, tracker, intrinsics, roles)
    for number, waiting in enumerate(reversed(tracker.waiting)):
        frame = Frame(waiting.frame, waiting.timestamp, waiting.image, waiting.depth, "")
        data = frame_data(frame, Description.of(waiting.features), intrinsics, roles, known.metric)
        # Backwards in time the motion of the last step continues as well as forwards.
        prior = MotionPrior(step @ pose, step, waited=min(number, 3))
        found = track(TrackingInput(data, intrinsics, roles, prior), keyframe, source)
        if not found.accepted:
            continue
        step, pose = found.pose @ rigid.invert(pose), found.pose
        placed[waiting.frame] = record_of(frame, found)
    frames = tuple(placed.get(record.frame, record) for record in tracker.frames)
    left = () if known.metric else (waiting for waiting in tracker.waiting if waiting.frame not in placed)
    return replace(tracker, frames=frames, waiting=(), unplaced=given_up(tracker, left))
