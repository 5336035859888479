"""Frames between keyframes: aligned to two of them, the reference and the next keyframe.

A frame that is tracked against one keyframe has the error of one alignment, and the path has a step where the reference
changes. So the last frames before that are also aligned to the next keyframe while their images are in memory. Both
relative motions are kept as measured. The pose of the frame is their mean by information, each with its systematic
error, which grows with the distance from its keyframe (`with_systematic`). So the path changes smoothly from one
keyframe to the next, wherever adjustments move them. Keyframes are not changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import POSE_GATE, inverse_information
from vggtgeo.models.classical import SensorDepth
from vggtgeo.slam.perception.rgbd_alignment import Aligned, RgbdAlignment
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.tracking.accumulated_odometry import squared_distance
from vggtgeo.slam.tracking.frame_tracking import view_of
from vggtgeo.slam.tracking.local_map_tracking import in_view
from vggtgeo.slam.tracking.pose_acceptance import MIN_CORRELATION, MIN_OVERLAP, MIN_SURFACE, TrackingQuality
from vggtgeo.slam.tracking.pose_fusion import with_systematic
from vggtgeo.slam.tracking.tracking_state import FramePose, SecondMotion, Tracker, frame_pose

FINEST = (4, 0, 0)
"""Iterations by level, the finest first: a frame starts within millimetres of its optimum."""
MAX_FRAMES_BETWEEN_KEYFRAMES = 16
"""Maximum number of frames whose images are kept for the next keyframe, 2 MB each. If the reference
stays longer, the nearest earlier keyframe is used."""


def with_view(known: Map, tracker: Tracker, view: RgbdView | None, intrinsics: np.ndarray, roles: Roles) -> Tracker:
    """Return the tracker with the view of its last frame, kept for the next keyframe.

    At most `MAX_FRAMES_BETWEEN_KEYFRAMES` views are kept.
    """
    measured = isinstance(roles.depth, SensorDepth) and roles.alignment is not None
    if view is None or not (measured and known.metric):
        return tracker
    tracker = replace(tracker, between=(*tracker.between, (len(tracker.frames) - 1, view)))
    return (
        against_nearest(known, tracker, intrinsics, roles)
        if len(tracker.between) == MAX_FRAMES_BETWEEN_KEYFRAMES
        else tracker
    )


def against_reference(known: Map, tracker: Tracker) -> Tracker:
    """Return the tracker after a change of the reference keyframe: waiting frames are aligned to the new one."""
    if tracker.reference is None:
        return replace(tracker, between=())
    return _against(known, tracker, *tracker.reference)


def against_nearest(known: Map, tracker: Tracker, intrinsics: np.ndarray, roles: Roles) -> Tracker:
    """Return the tracker with the waiting frames aligned to the nearest keyframe that they were not tracked against.

    For runs without a new keyframe for long, and for the end of a run.
    """
    if not tracker.between:
        return tracker
    last = tracker.frames[tracker.between[-1][0]]
    near = in_view(known.keyframes[known.roots[-1] :], frame_pose(known, last), last.reference)
    if not near:
        return replace(tracker, between=())
    return _against(known, tracker, near[0].number, view_of(near[0], tracker, intrinsics, roles))


def _against(known: Map, tracker: Tracker, number: int, source: RgbdView | None) -> Tracker:
    """Return the tracker with the waiting frames aligned to one keyframe, unless they were tracked against it."""
    keyframe = known.keyframes[number]

    def second(item: tuple[int, RgbdView]) -> SecondMotion | None:
        record, view = tracker.frames[item[0]], item[1]
        if source is None or record.reference == number:
            return None
        found = RgbdAlignment(FINEST).align(source, view, frame_pose(known, record) @ rigid.invert(keyframe.pose))
        if found is None or not _shows(found):
            return None
        return SecondMotion(number, rigid.orthonormal(found.motion), with_systematic(found.information, found.motion))

    frames = list(tracker.frames)
    for (row, _), motion in zip(tracker.between, map_in_threads(second, tracker.between), strict=True):
        frames[row] = replace(frames[row], second=motion)
    return replace(tracker, frames=tuple(frames), between=())


def by_both(known: Map, frames: Sequence[FramePose], poses: np.ndarray) -> np.ndarray:
    """Return world -> camera of all frames [n, 4, 4]: the mean of the poses by both keyframes, where they agree.

    poses: by the keyframe that each was tracked against.
    """
    rows = [row for row, record in enumerate(frames) if record.second is not None]
    if not rows:
        return poses
    records = [frames[row] for row in rows]
    seconds = [record.second for record in records if record.second is not None]
    placed = np.array([second.relative @ known.keyframes[second.keyframe].pose for second in seconds])
    own = np.array([tracked_information(record.quality) for record in records])
    other = np.array([second.information for second in seconds])
    apart = placed @ rigid.invert(poses[rows])
    off = np.concatenate([apart[:, :3, 3], Rotation.from_matrix(apart[:, :3, :3]).as_rotvec()], 1)
    # Mean of two Gaussians in the tangent space at the tracked pose: `(I1 + I2)^-1 I2 off`.
    share = np.linalg.solve(own + other, np.einsum("nij,nj->ni", other, off)[..., None])[..., 0]
    noise = inverse_information(own) + inverse_information(other)
    agreeing = squared_distance(placed, poses[rows], noise) < POSE_GATE
    found = poses.copy()
    found[rows] = np.where(agreeing[:, None, None], rigid.moved(poses[rows], share), poses[rows])
    return found


def _shows(found: Aligned) -> bool:
    """Return whether image and surface agree, as `TrackingQuality.dense_fair`; comparisons with NaN are false."""
    surface = not found.surface < MIN_SURFACE
    return bool(found.correlation >= MIN_CORRELATION and found.overlap >= MIN_OVERLAP and surface)


def tracked_information(quality: TrackingQuality) -> np.ndarray:
    """Return the information [6, 6] of a tracked pose by its worst directions; zero if they are unknown."""
    sigma = np.array([quality.sigma_translation, quality.sigma_rotation])
    return np.diag(1 / np.repeat(sigma, 3) ** 2) if np.isfinite(sigma).all() else np.zeros((6, 6))
