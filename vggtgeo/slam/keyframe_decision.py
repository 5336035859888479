"""Decision whether a frame becomes a keyframe: it sees enough that no keyframe of the map shows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.settings.groups import KeyframeSettings
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.relocalisation import close_loop_while_tracking, view_of
from vggtgeo.slam.tracking.track import FrameData, MotionPrior, Track, TrackingInput, tie_between, track


def becomes_keyframe(found: Track, settings: KeyframeSettings) -> bool:
    """Return whether a tracked frame needs a keyframe of its own (`needs_keyframe`); one placed by rays always does."""
    own, reference = found.pose, found.keyframe.pose
    return found.evidence.by_rays or needs_keyframe(own, reference, found.evidence.inliers, settings)


def needs_keyframe(pose: np.ndarray, keyframe_pose: np.ndarray, inliers: int, settings: KeyframeSettings) -> bool:
    """Return whether a frame moved or turned too far from its keyframe, or shares too little with it.

    Args:
        pose: of the frame, float64 [4, 4], world -> camera.
        keyframe_pose: of the keyframe that it was tracked against, likewise.
        inliers: matches with that keyframe that agree with the pose.
        settings: largest distance and angle, least inliers.

    """
    return view_change(pose, keyframe_pose, settings) > 1.0 or inliers < settings.min_inliers


def view_change(pose: np.ndarray, keyframe_pose: np.ndarray, settings: KeyframeSettings) -> float:
    """Return the larger of distance and angle between poses [4, 4], world -> camera, each as a share of its limit."""
    distance = np.linalg.norm(rigid.centre(pose) - rigid.centre(keyframe_pose))
    angle = rigid.angle_between(pose, keyframe_pose)
    return max(float(distance) / settings.keyframe_distance, float(angle) / settings.keyframe_angle)


def nearest_keyframe(pose: np.ndarray, keyframes: Iterable[Keyframe], settings: KeyframeSettings) -> Keyframe | None:
    """Return the keyframe with the smallest view change to `pose`; None if a frame there would need a new keyframe."""
    # Angles cost more than distances, and most keyframes of a long run are far away.
    near = [
        keyframe
        for keyframe in keyframes
        if np.linalg.norm(rigid.centre(keyframe.pose) - rigid.centre(pose)) < settings.keyframe_distance
    ]
    best = min(near, key=lambda keyframe: view_change(keyframe.pose, pose, settings), default=None)
    return best if best is not None and view_change(best.pose, pose, settings) < 1.0 else None


def track_by_old_keyframe(
    slam: Slam, data: FrameData, found: Track, roles: Roles, settings: SlamSettings
) -> tuple[Slam, Track]:
    """Track a frame by an old keyframe of the same place, if it shows the frame as well as the current keyframe does.

    So the map grows with space, not with time. A relative-pose factor by this frame connects both keyframes. Without
    such a keyframe, return the state and the track as given.
    """
    others = (keyframe for keyframe in slam.keyframes if keyframe.number != found.keyframe.number)
    near = nearest_keyframe(found.pose, others, settings.keyframes)
    again = None
    if near is not None:
        prior = MotionPrior(found.pose, slam.tracker.velocity)
        given = TrackingInput(data, slam.intrinsics, roles, prior)
        again = track(given, near, view_of(near, slam.tracker, slam.intrinsics, roles))
        if not (again.accepted and again.evidence.certain) or becomes_keyframe(again, settings.keyframes):
            again = None  # drift may have put another keyframe there
    if again is None:
        given = TrackingInput(data, slam.intrinsics, roles)
        again = close_loop_while_tracking(given, found, slam.map, slam.tracker, slam.window.members)
    if again is None or becomes_keyframe(again, settings.keyframes) or not again.evidence.shows_as_well(found.evidence):
        return slam, found
    near = again.keyframe
    if any({tie.first, tie.second} == {found.keyframe.number, near.number} for tie in slam.map.odometry_factors):
        return slam, again
    return replace(slam, map=replace(slam.map, factors=(*slam.map.factors, tie_between(found, again)))), again
