"""The fold: `step(slam, frame) -> slam`. Nothing here reads or writes a file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.models.roles import Features
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.keyframe import make_keyframe
from vggtgeo.slam.manhattan import constrain_rotation
from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.start import begin_again_with_depth, start_without_depth, without_depth
from vggtgeo.slam.state import FramePose, Slam
from vggtgeo.slam.tracking import Track, track_any
from vggtgeo.slam.window import adjust, enter

LOST_PATIENCE = 10
"""Frames that are only predicted before the map goes on from a new origin."""


def begin(camera: Camera, roles: Roles, settings: SlamSettings) -> Slam:
    """The state before the first frame."""
    intrinsics = np.array(camera.intrinsics, np.float64)
    relative = settings.known_intrinsics_sigma if camera.known else settings.guessed_intrinsics_sigma
    sigma = np.full(4, relative * intrinsics[0])
    return Slam(intrinsics, intrinsics, sigma, roles.metric)


@in_double_precision
def step(
    slam: Slam, frame: Frame, features: Features, roles: Roles, settings: SlamSettings, clock: Clock | None = None
) -> Slam:
    """Take one frame (undistorted) with its described key points into the state."""
    clock = clock or Clock()
    if not slam.metric:
        roles = without_depth(roles)
    if not slam.keyframes:
        return _first(slam, frame, features, roles, settings)
    if not _started(slam):
        with clock.measure("start"):
            begun = begin_again_with_depth(slam, frame, features, roles, settings) if slam.metric else None
            return begun or start_without_depth(slam, frame, features, roles, settings)
    return _follow(slam, frame, features, roles, settings, clock)


def _started(slam: Slam) -> bool:
    """Whether there is a map to track in. A later keyframe may well be without depth: its neighbours have some."""
    return len(slam.window) > 1 or bool(np.any(np.isfinite(slam.keyframes[slam.window[-1]].points.inverse_depth)))


def _first(slam: Slam, frame: Frame, features: Features, roles: Roles, settings: SlamSettings) -> Slam:
    """Begin a map at this frame: at the world's origin, or where tracking was lost."""
    number = len(slam.keyframes)
    keyframe = make_keyframe(number, frame, slam.last_pose, features, roles, settings, slam.intrinsics)
    record = FramePose(frame.index, frame.timestamp, number, np.eye(4), True, len(features))
    return replace(
        slam,
        keyframes=(*slam.keyframes, keyframe),
        window=(number,),
        prior=None,
        solved=None,
        origins=(*slam.origins, number),
        axes=(),
        frames=(*slam.frames, record),
        velocity=np.eye(4),
        lost=0,
    )


def _follow(slam: Slam, frame: Frame, features: Features, roles: Roles, settings: SlamSettings, clock: Clock) -> Slam:
    predicted = rigid.orthonormal(slam.velocity @ slam.last_pose)
    recent = [slam.keyframes[number] for number in reversed(slam.window[-3:])]
    with clock.measure("track"):
        found = track_any(
            frame.image, features, recent, predicted, slam.intrinsics, roles, enough=settings.least_inliers
        )
    if not found.found:
        return _missed(slam, frame, features, found, roles, settings)
    pose = found.guess.pose
    velocity = pose @ rigid.invert(slam.last_pose)
    slam = replace(slam, velocity=velocity, lost=0)
    if not _needs_keyframe(slam, found, settings):
        return _record(slam, frame, pose, found)
    number = len(slam.keyframes)
    with clock.measure("keyframe"):
        keyframe = make_keyframe(number, frame, pose, features, roles, settings, slam.intrinsics)
    with clock.measure("match keyframes"):
        slam = constrain_rotation(enter(slam, keyframe, roles, settings), settings)
    with clock.measure("adjust window"):
        slam = adjust(slam, settings)
    arrival = (found.keyframe.number, pose @ rigid.invert(found.keyframe.pose))
    record = FramePose(frame.index, frame.timestamp, number, np.eye(4), True, found.guess.inlier_count, arrival)
    return replace(slam, frames=(*slam.frames, record))


def _missed(slam: Slam, frame: Frame, features: Features, found: Track, roles: Roles, settings: SlamSettings) -> Slam:
    """Predict the pose; after too many such frames go on from a new origin."""
    if slam.lost == 0:
        note = f"tracking was lost at frame {frame.index} ({frame.name}): {found.guess.result.message}"
        slam = replace(slam, notes=(*slam.notes, note), velocity=np.eye(4))
    slam = replace(slam, lost=slam.lost + 1)
    if slam.lost > LOST_PATIENCE and len(features) > settings.least_inliers:
        note = f"the map goes on from a new origin at frame {frame.index} ({frame.name}); its place is only predicted"
        return _first(replace(slam, notes=(*slam.notes, note)), frame, features, roles, settings)
    reference = slam.frames[-1].reference
    record = FramePose(frame.index, frame.timestamp, reference, slam.frames[-1].relative, False, 0)
    return replace(slam, frames=(*slam.frames, record))


def _record(slam: Slam, frame: Frame, pose: np.ndarray, found: Track) -> Slam:
    relative = pose @ rigid.invert(found.keyframe.pose)
    record = FramePose(frame.index, frame.timestamp, found.keyframe.number, relative, True, found.guess.inlier_count)
    return replace(slam, frames=(*slam.frames, record))


def _needs_keyframe(slam: Slam, found: Track, settings: SlamSettings) -> bool:
    last = slam.keyframes[slam.window[-1]]
    distance = np.linalg.norm(rigid.centre(found.guess.pose) - rigid.centre(last.pose))
    return bool(
        distance > settings.keyframe_distance
        or rigid.angle_between(found.guess.pose, last.pose) > settings.keyframe_angle
        or found.guess.inlier_count < settings.least_inliers
        or found.keyframe.number != last.number
    )
