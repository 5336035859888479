"""Frames between keyframes: each against two of them, the one that it was tracked against and the one that comes next.

A frame that hangs on one keyframe has the error of one alignment, and its path jumps where the next takes over. So the
last frames before that moment are aligned to the next keyframe as well, while their pictures are at hand. Both motions
stay as they were measured; the pose of the frame is their mean by information, each with the error that no sample
removes, which grows with the way from its keyframe (`fusion.with_systematic`), so that the path passes smoothly from
one keyframe to the next, wherever adjustments move them. Keyframes stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import rigid
from vggtgeo.models.classical import SensorDepth
from vggtgeo.slam.perception.rgbd_alignment import Aligned, RgbdAlignment
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.tracking.evidence import LEAST_CORRELATION, LEAST_OVERLAP, LEAST_SURFACE, Evidence
from vggtgeo.slam.tracking.fusion import AGREEMENT_GATE, with_systematic
from vggtgeo.slam.tracking.map_points import in_view
from vggtgeo.slam.tracking.relocalisation import view_of
from vggtgeo.slam.tracking.tracker import FramePose, SecondMotion, Tracker, frame_pose

FINEST = (4, 0, 0)
"""Iterations by level, the finest first: a frame begins within millimetres of where it ends."""
MOST = 16
"""Frames whose pictures wait for the next keyframe, 2 MB each. Where one keyframe serves for longer, an earlier one
takes its part."""
NOTHING = 1e-9
"""Information, 1/m^2 and 1/rad^2, that is none: an inverse exists with it."""


def with_view(known: Map, tracker: Tracker, view: RgbdView | None, intrinsics: np.ndarray, roles: Roles) -> Tracker:
    """The tracker with the view of its last frame, which waits for the next keyframe; not for long."""
    measured = isinstance(roles.depth, SensorDepth) and roles.alignment is not None
    if view is None or not (measured and known.metric):
        return tracker
    tracker = replace(tracker, between=(*tracker.between, (len(tracker.frames) - 1, view)))
    return against_nearest(known, tracker, intrinsics, roles) if len(tracker.between) == MOST else tracker


def against_reference(known: Map, tracker: Tracker) -> Tracker:
    """The tracker after its reference keyframe has changed: frames that waited for it are aligned to it."""
    if tracker.reference is None:
        return replace(tracker, between=())
    return _against(known, tracker, *tracker.reference)


def against_nearest(known: Map, tracker: Tracker, intrinsics: np.ndarray, roles: Roles) -> Tracker:
    """The tracker after no other keyframe has come for long, or will: frames that wait are aligned to the nearest one
    that they were not tracked against.
    """
    if not tracker.between:
        return tracker
    last = tracker.frames[tracker.between[-1][0]]
    near = in_view(known.keyframes[known.roots[-1] :], frame_pose(known, last), last.reference)
    if not near:
        return replace(tracker, between=())
    return _against(known, tracker, near[0].number, view_of(near[0], tracker, intrinsics, roles))


def _against(known: Map, tracker: Tracker, number: int, source: RgbdView | None) -> Tracker:
    """The tracker with the frames that waited placed by one keyframe, as far as they were tracked against another."""
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
    """World -> camera of all frames [n, 4, 4], given what each is by the keyframe that it was tracked against: the mean
    with what the second motion says, where they agree.
    """
    rows = [row for row, record in enumerate(frames) if record.second is not None]
    if not rows:
        return poses
    records = [frames[row] for row in rows]
    seconds = [record.second for record in records if record.second is not None]
    placed = np.array([second.relative @ known.keyframes[second.keyframe].pose for second in seconds])
    own = np.array([tracked_information(record.evidence) for record in records])
    other = np.array([second.information for second in seconds])
    apart = placed @ rigid.invert(poses[rows])
    off = np.concatenate([apart[:, :3, 3], Rotation.from_matrix(apart[:, :3, :3]).as_rotvec()], 1)
    # Mean of two Gaussians in the tangent space at the tracked pose: `(I1 + I2)^-1 I2 off`.
    share = np.linalg.solve(own + other, np.einsum("nij,nj->ni", other, off)[..., None])[..., 0]
    agreeing = squared_distance(off, own, other) < AGREEMENT_GATE
    found = poses.copy()
    found[rows] = np.where(agreeing[:, None, None], rigid.moved(poses[rows], share), poses[rows])
    return found


def squared_distance(off: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Mahalanobis distances [n], squared, of poses `off` [n, 6] apart, in the noise of both, given their information
    [n, 6, 6]. A contradiction is left to the tracking, which had more witnesses.
    """
    none = NOTHING * np.eye(6)
    noise = np.linalg.inv(first + none) + np.linalg.inv(second + none)
    return np.asarray(np.einsum("ni,ni->n", off, np.linalg.solve(noise, off[..., None])[..., 0]))


def _shows(found: Aligned) -> bool:
    """As `Evidence.dense_fair`: comparisons with NaN, where there is nothing to compare, are false."""
    surface = not found.surface < LEAST_SURFACE
    return bool(found.correlation >= LEAST_CORRELATION and found.overlap >= LEAST_OVERLAP and surface)


def tracked_information(evidence: Evidence) -> np.ndarray:
    """Of a tracked pose [6, 6], by what it was known to in its worst directions; none where that is not known."""
    sigma = np.array([evidence.sigma_translation, evidence.sigma_rotation])
    return np.diag(1 / np.repeat(np.maximum(sigma, 1e-6), 3) ** 2) if np.isfinite(sigma).all() else np.zeros((6, 6))
