"""Refinement of a pose by the reprojection of known points, weighted and robust."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.gauss_newton import damped_step, gauss_newton
from vggtgeo.geometry.rigid import exponential


def refine_pose(
    pose: np.ndarray,
    points: np.ndarray,
    pixels: np.ndarray,
    weights: np.ndarray,
    intrinsics: np.ndarray,
    delta: float = 1.5,
    steps: int = 10,
) -> np.ndarray:
    """Return the pose T that minimises sum_n w_n rho(|pi(T X_n) - u_n|), with Huber's rho of `delta` pixels.

    The Jacobian is d pi / d xi for the left perturbation T <- exp(xi) T. Cost: O(n) a step.

    pose: [4, 4] world -> camera, the start. points [n, 3], pixels [n, 2], weights [n]. Returns float64 [4, 4].
    """

    def evaluate(pose: np.ndarray) -> tuple[float, Callable[[], np.ndarray]]:
        error, local = residuals(pose, points, pixels, intrinsics)
        # A point behind the camera costs as much as one a thousand pixels away, so that the energy stays finite.
        size = np.minimum(np.hypot(error[:, 0], error[:, 1]), 1e3)
        energy = weights @ np.where(size <= delta, size * size, delta * (2.0 * size - delta))
        return float(energy), lambda: _step(error, local, weights, intrinsics, delta)

    return gauss_newton(pose, evaluate, lambda pose, step: exponential(step) @ pose, steps=steps)


def residuals(
    pose: np.ndarray, points: np.ndarray, pixels: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return reprojection errors [n, 2], pixels, inf behind the camera, and points [n, 3] in the camera's frame."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    error = pinhole.project(local, intrinsics) - pixels
    return np.where(np.isnan(error), np.inf, error), local


def pose_information(pose: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, sigma: float) -> np.ndarray:
    """Return the information of matches about a pose, `sum J^T J / sigma^2`, by its left tangent, [6, 6].

    pose: [4, 4] world -> camera. points: [n, 3], the inliers. sigma: standard deviation of a match, pixels.
    """
    local = points @ pose[:3, :3].T + pose[:3, 3]
    row_x, row_y = pinhole.projection_rows(local[local[:, 2] > 1e-3], intrinsics)
    return (row_x @ row_x.T + row_y @ row_y.T) / sigma**2


def _step(
    error: np.ndarray, local: np.ndarray, weights: np.ndarray, intrinsics: np.ndarray, delta: float
) -> np.ndarray:
    use = np.isfinite(error[:, 0])
    if not use.all():
        error, local, weights = error[use], local[use], weights[use]
    weights = weights * np.minimum(1.0, delta / np.maximum(np.hypot(error[:, 0], error[:, 1]), 1e-12))
    row_x, row_y = pinhole.projection_rows(local, intrinsics)
    hessian = (row_x * weights) @ row_x.T + (row_y * weights) @ row_y.T
    return damped_step(hessian, row_x @ (weights * error[:, 0]) + row_y @ (weights * error[:, 1]))
