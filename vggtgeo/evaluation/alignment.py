"""Align two point sets by least squares: rigid, with scale, or yaw and position.

`align` accepts "none", "se3", "sim3" or "yaw". The last aligns heading and position, the unobservable directions of a
system with gravity (Z. Zhang and D. Scaramuzza, IROS 2018).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import real_array
from vggtgeo.io.errors import InputError

Alignment = Literal["none", "se3", "sim3", "yaw"]
Axis = Literal["x", "y", "z"]
AXES: dict[Axis, tuple[float, float, float]] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
VERTICAL = AXES["z"]
"""Default vertical axis of the ground truth: z, as in EuRoC and TUM RGB-D; ARKit and KITTI have y."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """`x -> scale * rotation @ x + translation`.

    Fields: rotation float64 [3, 3]; translation float64 [3], metres; scale > 0 (1 for a rigid motion).
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    scale: float = 1.0

    def points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the transformed points."""
        return self.scale * points @ self.rotation.T + self.translation

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """Return the trajectory in the new frame: positions transformed, orientations rotated."""
        poses = trajectory.poses.copy()
        poses[:, :3, :3] = self.rotation @ trajectory.rotations
        poses[:, :3, 3] = self.points(trajectory.positions)
        return Trajectory(trajectory.timestamps, poses)


def umeyama(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], with_scale: bool = False) -> Similarity:
    """Return the similarity that minimises `sum |s R source + t - target|^2`; s = 1 unless `with_scale`.

    With centred points, `C = target^T source / n = U D V^T` and `F = diag(1, 1, sign(det U det V))`:
    `R = U F V^T`, `s = tr(D F) / var(source)`, `t = mean(target) - s R mean(source)`.

    For collinear or coincident points the rotation is not unique, and one minimiser is returned. If all points of a set
    coincide (a camera that does not move), the scale is undefined and set to 1. Source: S. Umeyama, IEEE PAMI 13(4),
    1991.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centred = source - source_mean
    u, d, vt = np.linalg.svd((target - target_mean).T @ centred / len(source))
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * flip) @ vt
    variance, covariance = float((centred**2).sum() / len(source)), float(d @ flip)
    spread = np.ptp(source, axis=0).any() and np.ptp(target, axis=0).any()  # rounding: `variance` of equal points > 0
    scale = covariance / variance if with_scale and spread and variance > 0 and covariance > 0 else 1.0
    return Similarity(rotation, target_mean - scale * rotation @ source_mean, scale)


def heading(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    vertical: tuple[float, float, float] = VERTICAL,
) -> Similarity:
    """Return the rotation about `vertical` and the translation that minimise `sum |R source + t - target|^2`.

    With centred points s, t and the unit vector a, the sum of `t . R(theta) s` is `A cos(theta) + B sin(theta)` plus a
    constant, `A = sum t . s - (t . a)(s . a)`, `B = sum t . (a x s)`, so `theta = atan2(B, A)`. `vertical` may have any
    length. Raises InputError for an invalid `vertical`.
    """
    given = real_array("vertical", vertical, (3,))
    length = float(np.linalg.norm(given))
    if not 0 < length < np.inf:
        raise InputError(f"`vertical` must be a direction of three numbers, got {vertical}")
    axis = np.asarray(given, np.float64) / length
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    s, t = source - source_mean, target - target_mean
    level = float((s * t).sum() - (s @ axis) @ (t @ axis))
    angle = np.arctan2(float((t * np.cross(axis, s)).sum()), level)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return Similarity(rotation, target_mean - rotation @ source_mean)


def align(
    estimate: Trajectory,
    truth: Trajectory,
    kind: Alignment = "se3",
    vertical: tuple[float, float, float] = VERTICAL,
) -> Similarity:
    """Return the alignment of the matched poses of `estimate` to those of `truth`, by their positions.

    kind: "none" (same frame already), "se3", "sim3", or "yaw", about `vertical`.
    """
    if kind == "none":
        return Similarity(np.eye(3), np.zeros(3))
    if kind == "yaw":
        return heading(estimate.positions, truth.positions, vertical)
    return umeyama(estimate.positions, truth.positions, kind == "sim3")
