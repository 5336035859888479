"""When a frame becomes a keyframe: when it sees enough that its keyframe does not.

A distance is judged by what stands for a metre where the frame looks (`fusion.metre_of`): in a map of free scale that
is parallax, and no unit, however the unit drifts.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.settings.groups import KeyframeSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe


def needs_keyframe(
    pose: np.ndarray, keyframe_pose: np.ndarray, inliers: int, settings: KeyframeSettings, metre: float = 1.0
) -> bool:
    """Whether a tracked frame becomes a keyframe: it moved or turned too far from its keyframe, or shares too little.

    Args:
        pose: of the frame, float64 [4, 4], world -> camera.
        keyframe_pose: of the keyframe that it was tracked against, likewise.
        inliers: matches with that keyframe that agree with the pose.
        settings: largest distance and angle, least inliers.
        metre: what stands for a metre, in the unit of the map.

    """
    return view_change(pose, keyframe_pose, settings, metre) > 1.0 or inliers < settings.min_inliers


def view_change(pose: np.ndarray, keyframe_pose: np.ndarray, settings: KeyframeSettings, metre: float = 1.0) -> float:
    """Distance or angle between two poses, float64 [4, 4], world -> camera, the larger as a share of its limit."""
    distance = np.linalg.norm(rigid.centre(pose) - rigid.centre(keyframe_pose))
    angle = rigid.angle_between(pose, keyframe_pose)
    return max(float(distance) / (metre * settings.keyframe_distance), float(angle) / settings.keyframe_angle)


def nearest_keyframe(
    pose: np.ndarray, keyframes: Iterable[Keyframe], settings: KeyframeSettings, metre: float = 1.0
) -> Keyframe | None:
    """The keyframe with the smallest view change to `pose`; None if a frame at this pose would need a new keyframe."""
    # Angles cost more than distances, and most keyframes of a long run are far away.
    near = [
        keyframe
        for keyframe in keyframes
        if np.linalg.norm(rigid.centre(keyframe.pose) - rigid.centre(pose)) < metre * settings.keyframe_distance
    ]
    change = lambda keyframe: view_change(keyframe.pose, pose, settings, metre)
    best = min(near, key=change, default=None)
    return best if best is not None and change(best) < 1.0 else None
