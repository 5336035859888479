"""When a frame becomes a keyframe: when it sees enough that its keyframe does not."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.settings.groups import KeyframeSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe


def needs_keyframe(pose: np.ndarray, keyframe_pose: np.ndarray, inliers: int, settings: KeyframeSettings) -> bool:
    """Whether a tracked frame becomes a keyframe: it moved or turned too far from its keyframe, or shares too little.

    Args:
        pose: of the frame, float64 [4, 4], world -> camera.
        keyframe_pose: of the keyframe that it was tracked against, likewise.
        inliers: matches with that keyframe that agree with the pose.
        settings: largest distance and angle, least inliers.

    """
    return view_change(pose, keyframe_pose, settings) > 1.0 or inliers < settings.min_inliers


def view_change(pose: np.ndarray, keyframe_pose: np.ndarray, settings: KeyframeSettings) -> float:
    """Distance or angle between two poses, float64 [4, 4], world -> camera, the larger as a share of its limit."""
    distance = np.linalg.norm(rigid.centre(pose) - rigid.centre(keyframe_pose))
    angle = rigid.angle_between(pose, keyframe_pose)
    return max(float(distance) / settings.keyframe_distance, float(angle) / settings.keyframe_angle)


def nearest_keyframe(pose: np.ndarray, keyframes: Iterable[Keyframe], settings: KeyframeSettings) -> Keyframe | None:
    """The keyframe with the smallest view change to `pose`; None if a frame at this pose would need a new keyframe."""
    # Angles cost more than distances, and most keyframes of a long run are far away.
    near = [
        keyframe
        for keyframe in keyframes
        if np.linalg.norm(rigid.centre(keyframe.pose) - rigid.centre(pose)) < settings.keyframe_distance
    ]
    best = min(near, key=lambda keyframe: view_change(keyframe.pose, pose, settings), default=None)
    return best if best is not None and view_change(best.pose, pose, settings) < 1.0 else None
