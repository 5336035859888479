"""Pose from the points of several keyframes: projected, matched near their projection, and fused.

Each keyframe `k` gives normal equations `H_k, g_k` over the left tangent of the frame's pose, weighted by Tukey's
biweight. Its points cannot be more accurate than its own pose: the information used is `(H_k^-1 + F_k)^-1`, with `F_k`
the covariance of the motion between it and the reference keyframe. A keyframe that contradicts the known pose
(chi-square, 6 degrees of freedom), for example after drift, is not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.gauss_newton import damped_step
from vggtgeo.geometry.rigid import exponential
from vggtgeo.geometry.robust import POSE_GATE, TUKEY, inverse_information
from vggtgeo.models.classical import can_search, search_around, search_near, search_tree
from vggtgeo.models.roles import Features
from vggtgeo.slam.perception.rgbd_alignment import CONVERGED, MIN_DEPTH
from vggtgeo.slam.sparse_map.covisibility import REPROJECTION_GATE
from vggtgeo.slam.sparse_map.keyframe import PIXEL_SIGMA, Keyframe
from vggtgeo.slam.tracking.flow_tracking import MAX_POINTS
from vggtgeo.slam.tracking.pose_acceptance import tangent
from vggtgeo.slam.tracking.pose_fusion import with_systematic

MAX_KEYFRAMES = 4
"""Further keyframes that are searched: each costs a search in the frame's key points."""
MAX_TURN = np.deg2rad(45.0)
"""Largest angle between a keyframe and a frame: descriptors of key points change too much beyond."""
MIN_POINTS = 8
"""Minimum number of matches with a keyframe that count: few agree with a wrong pose by chance."""
STEPS = 4
"""Of Gauss-Newton, from a tracked pose."""


@dataclass(frozen=True, eq=False)
class Refined:
    """pose: float64 [4, 4], world -> camera. information: float64 [6, 6] of the points, over its left tangent. points,
    keyframes: numbers used.
    """

    pose: np.ndarray
    information: np.ndarray
    points: int
    keyframes: int


def refine_by_map(
    features: Features,
    keyframes: Sequence[Keyframe],
    reference: Keyframe,
    pose: np.ndarray,
    known: np.ndarray,
    intrinsics: np.ndarray,
) -> Refined | None:
    """Return the frame's pose refined by the points of `keyframes`; None without any.

    pose: world -> camera, with information `known` [6, 6] over its left tangent.
    """
    if not can_search(features):
        return None
    tree = search_tree(features)
    parts = []
    for keyframe in in_view(keyframes, pose, reference.number):
        part = _matched(keyframe, features, tree, pose, intrinsics)
        if part is not None and _agrees(part.equations(pose, intrinsics), known):
            parts.append(part)
    current, information = pose, np.zeros((6, 6))
    # Not `gauss_newton`: each keyframe's information is limited anew at each pose, so that there is no energy that must
    # fall.
    for _ in range(STEPS if parts else 0):
        equations = [part.equations(current, intrinsics) for part in parts]
        limited = [with_systematic(own.hessian, own.motion) for own in equations]
        information = np.sum(limited, axis=0)
        gradient = known @ tangent(current @ rigid.invert(pose))
        # Each keyframe pulls towards the pose that its points prefer, but only with the information that its own place
        # leaves.
        gradient -= np.sum([known @ own.step() for known, own in zip(limited, equations, strict=True)], axis=0)
        step = damped_step(information + known, gradient)
        current = exponential(step) @ current
        if np.abs(step).max() < CONVERGED:
            break
    return Refined(current, information, sum(len(part.points) for part in parts), len(parts)) if parts else None


def joint_matches(
    features: Features, keyframes: Sequence[Keyframe], pose: np.ndarray, intrinsics: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Match points of all keyframes in view within `radius` of their projection by a rough `pose`.

    Returns world points float64 [n, 3], pixels [n, 2], confidence [n]. A key point of the frame may match a point of
    each keyframe.
    """
    found = [(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))]
    for keyframe in in_view(keyframes, pose) if can_search(features) else []:
        if can_search(keyframe.features):
            index, points, pixels = expected_pixels(keyframe, pose, intrinsics)
            matches = search_around(keyframe.features, index, pixels, features, radius=radius)
            found.append((points[np.searchsorted(index, matches.index_i)], matches.pixels_j, matches.confidence))
    points, pixels, confidence = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return points, pixels, confidence


def in_view(keyframes: Sequence[Keyframe], pose: np.ndarray, but: int = -1) -> list[Keyframe]:
    """Return the nearest keyframes with a similar viewing direction, nearest first, without the keyframe `but`."""
    others = [keyframe for keyframe in keyframes if keyframe.number != but]
    poses = np.array([keyframe.pose for keyframe in others]).reshape(-1, 4, 4)
    away = np.linalg.norm(rigid.invert(poses)[:, :3, 3] - rigid.centre(pose), axis=1)
    # `trace(R1 R2') = 1 + 2 cos(angle)`.
    cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3]) - 1) / 2
    turned = np.arccos(np.clip(cosine, -1.0, 1.0))
    order = [i for i in np.argsort(away + turned, kind="stable") if turned[i] < MAX_TURN]
    return [others[i] for i in order[:MAX_KEYFRAMES]]


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations `H, g` of one keyframe's points at a pose, and the motion keyframe -> frame there."""

    hessian: np.ndarray
    gradient: np.ndarray
    motion: np.ndarray

    def step(self) -> np.ndarray:
        """Return the step that these points alone would take."""
        return damped_step(self.hessian, self.gradient)


@dataclass(frozen=True, eq=False)
class _Part:
    """World points of one keyframe, [n, 3], and their pixels in the frame, [n, 2]."""

    keyframe: Keyframe
    points: np.ndarray
    pixels: np.ndarray

    def equations(self, pose: np.ndarray, intrinsics: np.ndarray) -> _Equations:
        local = self.points @ pose[:3, :3].T + pose[:3, 3]
        # The projection's derivative is unbounded at the camera.
        front = local[:, 2] > MIN_DEPTH
        local = local[front]
        residual = (pinhole.project(local, intrinsics) - self.pixels[front]) / PIXEL_SIGMA
        rows = pinhole.projection_rows(local, intrinsics)
        size = np.linalg.norm(residual, axis=1)
        weight = np.maximum(1.0 - (size / TUKEY) ** 2, 0.0) ** 2
        hessian = sum((row * weight) @ row.T for row in rows) / PIXEL_SIGMA**2
        gradient = sum(row @ (weight * residual[:, axis]) for axis, row in enumerate(rows)) / PIXEL_SIGMA
        return _Equations(np.asarray(hessian), np.asarray(gradient), pose @ rigid.invert(self.keyframe.pose))


def _matched(
    keyframe: Keyframe, features: Features, tree: cKDTree, pose: np.ndarray, intrinsics: np.ndarray
) -> _Part | None:
    """Match some of the keyframe's points of known depth that are expected in the image."""
    if not can_search(keyframe.features):
        return None
    index, points, pixels = expected_pixels(keyframe, pose, intrinsics)
    # Key points come strongest first, spread over the image.
    index, points, pixels = index[:MAX_POINTS], points[:MAX_POINTS], pixels[:MAX_POINTS]
    found = search_near(keyframe.features, index, pixels, features, tree, radius=REPROJECTION_GATE)
    if len(found) < MIN_POINTS:
        return None
    return _Part(keyframe, points[np.searchsorted(index, found.index_i)], found.pixels_j)


def expected_pixels(
    keyframe: Keyframe, pose: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return key points of known depth expected in the image: their numbers (ascending), world points, pixels."""
    known = np.nonzero(np.isfinite(keyframe.points.inverse_depth))[0]
    points = rigid.unproject(
        keyframe.features.pixels[known], keyframe.points.inverse_depth[known], keyframe.pose, intrinsics
    )
    height, width = keyframe.size
    pixels = rigid.project(points, pose, intrinsics)
    with np.errstate(invalid="ignore"):
        inside = ((pixels > 0) & (pixels < [width - 1, height - 1])).all(1)
    return known[inside], points[inside], pixels[inside]


def _agrees(own: _Equations, known: np.ndarray) -> bool:
    """Return whether these points agree with the known pose within the noise of both."""
    noise = inverse_information(with_systematic(own.hessian, own.motion)) + inverse_information(known)
    step = own.step()
    return float(step @ np.linalg.solve(noise, step)) < POSE_GATE
