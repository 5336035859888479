"""Fusion of points, image, lines and motion prior into one motion from keyframe to frame.

Estimates are averaged by information in the tangent space of the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.geometry.robust import POSE_GATE, REGULARISER, inverse_information
from vggtgeo.models.roles import LineFeatures, LineMatcher
from vggtgeo.slam.perception.rgbd_alignment import MAX_DISTANCE, Aligned
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import NOMINAL_DEPTH
from vggtgeo.slam.tracking.line_alignment import align_lines
from vggtgeo.slam.tracking.pose_acceptance import SYSTEMATIC, TrackingQuality, tangent


@dataclass(frozen=True, eq=False)
class Motion:
    """Keyframe camera -> frame camera, float64 [4, 4], and its information [6, 6] over the left tangent."""

    motion: np.ndarray
    information: np.ndarray


def agreed(by_points: Motion | None, dense: Aligned | None, quality: TrackingQuality) -> Motion | None:
    """Return the mean of both motions if they agree within their noise, else the one with the better evidence."""
    if dense is None:
        return by_points
    by_picture = Motion(dense.motion, dense.information)
    if by_points is None:
        return by_picture
    off = tangent(by_points.motion @ rigid.invert(dense.motion))
    # With the errors that samples share: by their own noise alone two right poses would contradict each other.
    noise = [np.linalg.inv(with_systematic(one.information, one.motion)) for one in (by_points, by_picture)]
    if off @ np.linalg.solve(noise[0] + noise[1], off) < POSE_GATE:
        both = by_points.information + dense.information
        mean = np.linalg.solve(both + REGULARISER * np.eye(6), by_points.information @ off)
        return Motion(exponential(mean) @ dense.motion, both)
    # Points that lie on one plane, or few of them, are often some centimetres off: the picture mends that.
    # Farther away it was aligned to other surfaces than those that many inliers lie on.
    near = np.linalg.norm(off[:3]) < MAX_DISTANCE or not quality.points_strong
    return by_picture if quality.dense_fair and near else by_points


def fused_with_prior(found: Motion, prior: Motion) -> Motion:
    """Return the mean of a measured motion and the motion prior.

    The prior continues the motion in weakly constrained directions. The information is that of the measurement alone.
    """
    off = tangent(prior.motion @ rigid.invert(found.motion))
    step = np.linalg.solve(found.information + prior.information, prior.information @ off)
    # The prior is no measurement: counted as one, it would make directions that nothing measured look measured.
    return Motion(exponential(step) @ found.motion, found.information)


def weakly_constrained(found: Motion) -> bool:
    """Return whether the standard deviation in some direction exceeds the systematic error of the motion.

    Elsewhere neither lines nor points of other keyframes improve the pose (docs/results/clips.md), and line detection
    costs as much as the alignment.
    """
    floor = _systematic_sigma(found.motion)
    return bool(np.linalg.eigvalsh(found.information * np.outer(floor, floor))[0] < 1.0)


def metre_of(points: np.ndarray, pose: np.ndarray) -> float:
    """Return the length that stands for a metre in a map of free scale, in its unit, at points [m, 3] seen from a pose
    [4, 4].

    The mean inverse depth determines the image motion for a motion of one unit. In the first views of a map it is about
    `1 / NOMINAL_DEPTH`, and thresholds are in metres there; positions are less accurate where everything is far away.
    """
    if not len(points):
        return 1.0
    # A mean of inverse depths, since image motion is proportional to it; far points then do not dominate.
    depth = points @ pose[2, :3] + pose[2, 3]
    return float(len(points) / (NOMINAL_DEPTH * np.sum(1.0 / depth)))


def with_lines(
    found: Motion | None,
    prior: Motion | None,
    quality: TrackingQuality,
    keyframe: Keyframe,
    seen: LineFeatures,
    intrinsics: np.ndarray,
    matcher: LineMatcher,
) -> tuple[Motion | None, TrackingQuality]:
    """Return the motion refined by line segments, with the evidence; without a measured motion, from the prior."""
    measured = np.zeros((6, 6)) if found is None else found.information
    start = prior if found is None else found
    assert start is not None
    known = measured if prior is None else measured + prior.information
    lines = align_lines(keyframe, seen, matcher, start.motion, known, intrinsics)
    if lines is None:
        return found, quality
    quality = replace(quality, lines=lines.agreed, visible_lines=lines.visible)
    return Motion(lines.motion, measured + lines.information), quality


def with_systematic(information: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return the information of a motion after adding its systematic error."""
    return np.linalg.inv(inverse_information(information) + np.diag(_systematic_sigma(motion) ** 2))


def _systematic_sigma(motion: np.ndarray) -> np.ndarray:
    """Return the standard deviations float64 [6] of a motion's systematic error, which samples share."""
    length, angle = (np.linalg.norm(part) for part in np.split(tangent(motion), 2))
    metres, radians, share = SYSTEMATIC
    # Calibration errors grow with the motion; rolling shutter and clock errors do not vanish without it.
    return np.repeat([metres + share * length, radians + share * angle], 3)
