"""Decision whether a frame becomes a keyframe: it sees enough that no keyframe of the map shows."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.slam.camera.camera_estimate import MIN_KEYFRAMES_FOR_CAMERA
from vggtgeo.slam.settings.groups import KeyframeSettings
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.covisibility import SAMPLES, share_inside
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.frame_tracking import (
    FrameData,
    MotionPrior,
    TrackedFrame,
    TrackingInput,
    factor_between,
    track,
    view_of,
)
from vggtgeo.slam.tracking.relocalisation import close_loop_while_tracking

MIN_OVERLAP, MAX_PARALLAX = 0.8, math.radians(10.0)
"""Minimum share of a keyframe's key points in the image, and largest angle between a point's rays, of a frame that does
not become a keyframe, where lengths have no unit. In simulated walks limits from 0.9 and 5 degrees to 0.7 and 10 are
equally accurate (`benchmarks/keyframe_spacing.py`)."""
MAX_SHIFT = 1.0
"""Pixels by which errors of the keyframe's depths may move its points in the image: the noise of a match. Beyond it
the map, not the image, limits the pose."""
THIRD_VIEW = 0.25
"""Share of these limits at which a map gets its third keyframe: early, since nothing checks the depths of two."""


def becomes_keyframe(slam: Slam, found: TrackedFrame, settings: KeyframeSettings) -> bool:
    """Return whether a tracked frame becomes a keyframe (`needs_keyframe`); one placed by rays alone always does."""
    quality = found.quality
    return quality.by_two_view or needs_keyframe(slam, found.pose, found.keyframe, quality.inliers, settings)


def needs_keyframe(slam: Slam, pose: np.ndarray, keyframe: Keyframe, inliers: int, settings: KeyframeSettings) -> bool:
    """Return whether a frame sees too little of its keyframe (`view_change`), or shares too few matches with it.

    pose: of the frame, float64 [4, 4], world -> camera. inliers: matches with the keyframe that agree with the pose.
    """
    return view_change(slam, pose, keyframe, settings) > 1.0 or inliers < settings.min_inliers


def view_change(slam: Slam, pose: np.ndarray, keyframe: Keyframe, settings: KeyframeSettings) -> float:
    """Return the change of the view from a keyframe to `pose` [4, 4], world -> camera, as a share of its limit.

    The larger of distance and angle where lengths are metres, else of lost overlap and parallax.
    """
    if not slam.metric:
        # A third view is the first that checks the depths of two, and without it nothing is adjusted at the end.
        limit = 1.0 if len(slam.keyframes) >= MIN_KEYFRAMES_FOR_CAMERA else THIRD_VIEW
        return _unitless_change(pose, keyframe, slam.intrinsics) / limit
    share = float(np.linalg.norm(rigid.centre(pose) - rigid.centre(keyframe.pose))) / settings.keyframe_distance
    # Angles cost more than distances, and most keyframes of a long run are beyond the limit by distance alone.
    return share if share > 1.0 else max(share, rigid.angle_between(pose, keyframe.pose) / settings.keyframe_angle)


def _unitless_change(pose: np.ndarray, keyframe: Keyframe, intrinsics: np.ndarray) -> float:
    """Return the largest of three shares of their limits: overlap that is lost, parallax, and shift by depth errors.

    The parallax is the root mean square of the angles between the rays to a point from both places: near points
    determine the position, and count most. A point of unknown depth counts as the mean of the others, and as infinitely
    far where no depth is known.
    """
    some = np.s_[:: max(len(keyframe.points.pixels) // SAMPLES, 1)]
    inverse = keyframe.points.inverse_depth[some]
    known = np.isfinite(inverse)
    inverse = np.where(known, inverse, np.mean(inverse[known]) if known.any() else 0.0)
    relative = pose @ rigid.invert(keyframe.pose)
    turned = pinhole.rays(keyframe.points.pixels[some], intrinsics) @ relative[:3, :3].T
    moved = turned + inverse[:, None] * relative[:3, 3]
    left = 1.0 - share_inside(pinhole.project(moved, intrinsics), keyframe)
    sine = np.linalg.norm(np.cross(turned, moved), axis=1)
    parallax = np.sqrt(np.mean(np.arctan2(sine, (turned * moved).sum(1)) ** 2))
    sigma = keyframe.points.estimate_sigma[np.isfinite(keyframe.points.estimate_sigma)]
    shift = float(intrinsics[0] * np.linalg.norm(relative[:3, 3]) * np.median(sigma)) if len(sigma) else 0.0
    return float(max(left / (1.0 - MIN_OVERLAP), parallax / MAX_PARALLAX, shift / MAX_SHIFT))


def nearest_keyframe(
    slam: Slam, pose: np.ndarray, keyframes: Iterable[Keyframe], settings: KeyframeSettings
) -> Keyframe | None:
    """Return the keyframe with the smallest view change to `pose`; None if a frame there would need a new keyframe."""
    changes = [(view_change(slam, pose, keyframe, settings), keyframe) for keyframe in keyframes]
    change, best = min(changes, key=lambda one: one[0], default=(1.0, None))
    return best if change < 1.0 else None


def track_by_old_keyframe(
    slam: Slam, data: FrameData, found: TrackedFrame, roles: Roles, settings: SlamSettings
) -> tuple[Slam, TrackedFrame]:
    """Track a frame by an old keyframe of the same place, if it shows the frame as well as the current keyframe does.

    So the map grows with space, not with time. A relative-pose factor by this frame connects both keyframes. Without
    such a keyframe, return the state and the track as given.
    """
    others = (keyframe for keyframe in slam.keyframes if keyframe.number != found.keyframe.number)
    near = nearest_keyframe(slam, found.pose, others, settings.keyframes)
    again = None
    if near is not None:
        prior = MotionPrior(found.pose, slam.tracker.velocity)
        given = TrackingInput(data, slam.intrinsics, roles, prior)
        again = track(given, near, view_of(near, slam.tracker, slam.intrinsics, roles))
        if not (again.accepted and again.quality.certain) or becomes_keyframe(slam, again, settings.keyframes):
            again = None  # drift may have put another keyframe there
    if again is None:
        given = TrackingInput(data, slam.intrinsics, roles)
        again = close_loop_while_tracking(given, found, slam.map, slam.tracker, slam.window.members)
    if (
        again is None
        or becomes_keyframe(slam, again, settings.keyframes)
        or not again.quality.shows_as_well(found.quality)
    ):
        return slam, found
    near = again.keyframe
    if any(
        {factor.first, factor.second} == {found.keyframe.number, near.number} for factor in slam.map.odometry_factors
    ):
        return slam, again
    return slam.with_factors(factor_between(found, again)), again
