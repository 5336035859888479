"""Final poses of all frames: relative to their keyframes and, without measured depth, resected and smoothed.

Without measured depth a frame is tracked against depths from two or three keyframes, and later adjustments change the
map. Poses relative to keyframes would then have a step at each new keyframe. So a frame keeps some of its tracked
points (`SeenPoints`), and its pose is estimated from them in the final map (resection), with the tracked pose as a
prior (`benchmarks/between_keyframes.py`). The matches of that prior share the errors of their depths, so its
information is divided by `SHARED_ERRORS`. What the points leave open is filled in by `smooth_motion.py`.
"""

from __future__ import annotations

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.gauss_newton import damped_step
from vggtgeo.geometry.robust import FEW, sigma_by_median
from vggtgeo.slam.camera.rolling_shutter import to_global_shutter
from vggtgeo.slam.global_map.pose_uncertainty import SHARED_ERRORS
from vggtgeo.slam.global_map.propagated_poses import camera_motions, frame_motions, propagated_poses
from vggtgeo.slam.global_map.smooth_motion import smoothed
from vggtgeo.slam.perception.rgbd_alignment import MIN_DEPTH
from vggtgeo.slam.sparse_map.map import submap_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.tracking.frame_refinement import tracked_information
from vggtgeo.slam.tracking.pose_acceptance import tangent

WIDTH, MAX_WIDTH = 1.0, 8.0
"""Width of the Geman-McClure kernel, pixels: final and initial, halved in each step. A redescending kernel, because
matches may be off by as much as the gate of tracking, some pixels (`benchmarks/between_keyframes.py`)."""
STEPS, CONVERGED = 15, 1e-5
"""Iteration limit, and the step, metres and radians, that ends the iteration: with a redescending kernel steps shrink
slowly, and after one of 1e-4 the pose may still be off by as much."""
MIN_NOISE = 0.01
"""Smallest noise of a match, pixels, below that of any image: a simulation has none, and its information is finite."""

_FOUND: WeakKeyDictionary[Slam, tuple[np.ndarray, np.ndarray]] = WeakKeyDictionary()
"""Poses by the state that they are of, which never changes: the outputs of a run ask for them again and again, and each
time every frame would be resected."""


def frame_poses(slam: Slam) -> tuple[np.ndarray, np.ndarray]:
    """Return times [n], s, and poses [n, 4, 4], world -> camera, of all frames; for a lost frame the last known pose.

    Resection is done only after the last adjustment, since that moves the map once more.
    """
    if slam not in _FOUND:
        _FOUND[slam] = _frame_poses(slam)
    times, poses = _FOUND[slam]
    return times.copy(), poses.copy()


def _frame_poses(slam: Slam) -> tuple[np.ndarray, np.ndarray]:
    times, poses = propagated_poses(slam)
    rows = [row for row, record in enumerate(slam.frames) if record.seen is not None and record.tracked]
    if not rows or not slam.map.finished:
        return times, poses
    # With metric depth the errors that frames share are in the tracked information already.
    as_one = 1.0 if slam.metric else SHARED_ERRORS
    information = np.array([tracked_information(record.quality) / as_one for record in slam.frames])
    rolling = slam.camera.readout is not None
    motions = (camera_motions(slam, len(slam.keyframes)), frame_motions(slam)) if rolling else None

    def placed(row: int) -> _Resected:
        points, pixels = _seen_points(slam, row, poses[row], motions)
        return _resected(points, pixels, poses[row], information[row], slam.intrinsics)

    found, resected = poses.copy(), map_in_threads(placed, rows)
    found[rows] = [one.pose for one in resected]
    noise = sigma_by_median(np.concatenate([one.residuals.ravel() for one in resected] + [np.full(1, MIN_NOISE)]))
    for row, one in zip(rows, resected, strict=True):
        if len(one.residuals):
            information[row] = information[row] + one.information / (as_one * max(noise, MIN_NOISE) ** 2)
    if slam.metric:
        return times, found
    submap = submap_of(slam.map)
    label = np.array([submap[record.reference] if record.tracked else -1 for record in slam.frames])
    apart = np.array([not np.array_equal(record.relative, np.eye(4)) for record in slam.frames])
    return times, smoothed(times, found, information, apart & information.any((1, 2)), label)


def _seen_points(
    slam: Slam, row: int, pose: np.ndarray, motions: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return world points [m, 3] of the matches of a frame with a final depth, and their pixels in it, [m, 2].

    pose: near the frame's. motions: velocities at all keyframes and at all frames if a readout time is known; pixels
    are then those of a global shutter.
    """
    record, readout = slam.frames[row], slam.camera.readout
    assert record.seen is not None
    keyframe, slots = slam.keyframes[record.reference], record.seen.slots
    inverse = keyframe.points.inverse_depth[slots]
    known = np.isfinite(inverse) & (inverse > 0)
    inverse, own = inverse[known], keyframe.points.pixels[slots[known]]
    pixels = record.seen.pixels[known].astype(np.float64)
    if motions is None or readout is None:
        return rigid.unproject(own, inverse, keyframe.pose, slam.intrinsics), pixels
    shutter = slam.intrinsics, keyframe.size, readout
    own = to_global_shutter(own, inverse, motions[0][record.reference], *shutter)
    points = rigid.unproject(own, inverse, keyframe.pose, slam.intrinsics)
    there = 1.0 / (points @ pose[2, :3] + pose[2, 3])
    return points, to_global_shutter(pixels, there, motions[1][row], *shutter)


class _Resected(NamedTuple):
    """A pose [4, 4] by points, their information about it [6, 6] for a noise of one pixel, and their residuals [m, 2],
    pixels; none where the pose stays for lack of points.
    """

    pose: np.ndarray
    information: np.ndarray = np.zeros((6, 6))
    residuals: np.ndarray = np.zeros((0, 2))


def _resected(
    points: np.ndarray, pixels: np.ndarray, pose: np.ndarray, known: np.ndarray, intrinsics: np.ndarray
) -> _Resected:
    """Return the pose [4, 4] near `pose`, with prior information `known` [6, 6], of points [m, 3] at pixels [m, 2].

    Robust; `pose` itself if there are few points, or the energy does not fall.
    """
    if len(points) < FEW:
        return _Resected(pose)
    current, before = pose, _energy(points, pixels, pose, intrinsics)
    information, off = np.zeros((6, 6)), np.zeros((0, 2))
    # Not `gauss_newton`: the width shrinks from step to step, and energies of two widths cannot be compared. Called
    # once for each width it finds the same pose in 2.0 ms instead of 1.6.
    for number in range(STEPS):
        # Graduated non-convexity: from a pose that is off, right matches look like outliers to the final width.
        width = max(MAX_WIDTH / 2**number, WIDTH)
        local = points @ current[:3, :3].T + current[:3, 3]
        front = local[:, 2] > MIN_DEPTH
        if np.count_nonzero(front) < FEW:
            return _Resected(pose)
        off = pinhole.project(local[front], intrinsics) - pixels[front]
        weight = 1.0 / (1.0 + (off**2).sum(1) / width**2) ** 2
        rows = np.concatenate(pinhole.projection_rows(local[front], intrinsics), 1)
        weighted = rows * np.tile(weight, 2)
        information = weighted @ rows.T
        hessian = information + known
        gradient = weighted @ off.T.ravel() + known @ tangent(current @ rigid.invert(pose))
        step = damped_step(hessian, gradient)
        current = rigid.moved(current[None], step[None])[0]
        if width == WIDTH and np.abs(step).max() < CONVERGED:
            break
    # A redescending kernel has other minima: a step away from the tracked pose must lower the energy.
    better = _energy(points, pixels, current, intrinsics) < before
    return _Resected(rigid.orthonormal(current) if better else pose, information, off)


def _energy(points: np.ndarray, pixels: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray) -> float:
    """Return the robust energy; a point behind the camera counts as an outlier."""
    square = ((rigid.project(points, pose, intrinsics) - pixels) ** 2).sum(1) / WIDTH**2
    return float(np.where(np.isfinite(square), square / (1.0 + square), 1.0).sum())
