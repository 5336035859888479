"""When a frame becomes a keyframe: when it sees enough that its keyframe does not.

A distance is judged by what stands for a metre where the frame looks (`fusion.metre_of`): in a map of free scale that
is parallax, and no unit, however the unit drifts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.settings.groups import KeyframeSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe

FREE_SPAN = 2.0
"""Both limits, in those of a map with measured depth, where scale is free. There keyframes hand the unit on from one to
the next: half as many do so half as often, over twice the parallax. Building-walk is 18 cm off before its last
adjustment in place of 36."""


@dataclass(frozen=True)
class Limits:
    """How far a frame may be from its keyframe, in the unit of the map, and turned from it, radians."""

    distance: float
    angle: float

    @classmethod
    def of(cls, settings: KeyframeSettings, metre: float | None = None) -> Limits:
        """Those of the settings, in metres; in a map of free scale `metre` stands for one where the frame looks."""
        if metre is None:
            return cls(settings.keyframe_distance, settings.keyframe_angle)
        return cls(FREE_SPAN * metre * settings.keyframe_distance, FREE_SPAN * settings.keyframe_angle)


def needs_keyframe(pose: np.ndarray, keyframe_pose: np.ndarray, inliers: int, limits: Limits, min_inliers: int) -> bool:
    """Whether a tracked frame becomes a keyframe: it moved or turned too far from its keyframe, or shares too little.

    Args:
        pose: of the frame, float64 [4, 4], world -> camera.
        keyframe_pose: of the keyframe that it was tracked against, likewise.
        inliers: matches with that keyframe that agree with the pose.
        limits: largest distance and angle.
        min_inliers: least inliers.

    """
    return view_change(pose, keyframe_pose, limits) > 1.0 or inliers < min_inliers


def view_change(pose: np.ndarray, keyframe_pose: np.ndarray, limits: Limits) -> float:
    """Distance or angle between two poses, float64 [4, 4], world -> camera, the larger as a share of its limit."""
    distance = np.linalg.norm(rigid.centre(pose) - rigid.centre(keyframe_pose))
    angle = rigid.angle_between(pose, keyframe_pose)
    return max(float(distance) / limits.distance, float(angle) / limits.angle)


def nearest_keyframe(pose: np.ndarray, keyframes: Iterable[Keyframe], limits: Limits) -> Keyframe | None:
    """The keyframe with the smallest view change to `pose`; None if a frame at this pose would need a new keyframe."""
    # Angles cost more than distances, and most keyframes of a long run are far away.
    near = [
        keyframe
        for keyframe in keyframes
        if np.linalg.norm(rigid.centre(keyframe.pose) - rigid.centre(pose)) < limits.distance
    ]
    best = min(near, key=lambda keyframe: view_change(keyframe.pose, pose, limits), default=None)
    return best if best is not None and view_change(best.pose, pose, limits) < 1.0 else None
