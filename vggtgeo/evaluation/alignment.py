"""The similarity that best carries one point set onto another (Umeyama's closed form)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class Similarity:
    """`x -> scale * rotation @ x + translation`.

    Fields: rotation float64 [3, 3]; translation float64 [3], metres; scale > 0 (1 for a rigid motion).
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    scale: float = 1.0

    def points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The moved points."""
        return self.scale * points @ self.rotation.T + self.translation

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory in the new frame: positions moved and scaled, orientations turned."""
        poses = trajectory.poses.copy()
        poses[:, :3, :3] = self.rotation @ trajectory.rotations
        poses[:, :3, 3] = self.points(trajectory.positions)
        return Trajectory(trajectory.timestamps, poses)


def umeyama(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], with_scale: bool = False) -> Similarity:
    """The similarity with the least `sum |s R source + t - target|^2`; s = 1 unless `with_scale`.

    With centred points, `C = target^T source / n = U D V^T` and `F = diag(1, 1, sign(det U det V))`:
    `R = U F V^T`, `s = tr(D F) / var(source)`, `t = mean(target) - s R mean(source)`.

    Points on a line, or all at one place, leave the rotation free: one of the minimisers is returned. Where
    the points of either set all coincide (a still camera) the scale means nothing and is 1. Source: S.
    Umeyama, IEEE PAMI 13(4), 1991. InputError for no points, other shapes, or NaN.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) == 0:
        raise InputError(
            f"`source` has shape {source.shape}, `target` {target.shape}; both must be [n, 3], n at least 1"
        )
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise InputError("`source` or `target` has a NaN or an infinity; leave such points out")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centred = source - source_mean
    u, d, vt = np.linalg.svd((target - target_mean).T @ centred / len(source))
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * flip) @ vt
    variance, covariance = float((centred**2).sum() / len(source)), float(d @ flip)
    scale = covariance / variance if with_scale and variance > 0 and covariance > 0 else 1.0
    return Similarity(rotation, target_mean - scale * rotation @ source_mean, scale)
