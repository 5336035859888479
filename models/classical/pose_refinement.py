"""The pose that reprojects known points best: weighted, robust Gauss-Newton on SE(3)."""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import pinhole
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
    """Minimise sum_n w_n rho(|pi(T X_n) - u_n|) over T, with rho Huber's of `delta` pixels.

    Each step solves the 6 x 6 normal equations of J = d pi / d xi for the left perturbation T <- exp(xi) T, and is
    halved until the energy falls. Cost: O(n) a step.

    pose: [4, 4] world -> camera, the start. points [n, 3], pixels [n, 2], weights [n]. Returns float64 [4, 4].
    """
    current, (energy, error, local) = pose, _judged(pose, points, pixels, weights, intrinsics, delta)
    for _ in range(steps):
        step = _gauss_newton_step(error, local, weights, intrinsics, delta)
        for fraction in (1.0, 0.5, 0.25, 0.125):
            trial = exponential(fraction * step) @ current
            trial_energy, error, local = _judged(trial, points, pixels, weights, intrinsics, delta)
            if trial_energy < energy:
                break
        else:
            return current
        gained, current, energy = energy - trial_energy, trial, trial_energy
        if gained < 1e-7 * energy + 1e-12:
            return current
    return current


def residuals(
    pose: np.ndarray, points: np.ndarray, pixels: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Reprojection errors float [n, 2] in pixels and camera-frame points [n, 3]; errors are inf behind the camera."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    error = pinhole.project(local, intrinsics) - pixels
    return np.where(np.isnan(error), np.inf, error), local


def pose_information(pose: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, sigma: float) -> np.ndarray:
    """What matches know of a pose: `sum J^T J / sigma^2` over its left tangent, float64 [6, 6], translation first.

    pose: [4, 4] world -> camera. points: [n, 3], the inliers. sigma: standard deviation of a match, pixels.
    """
    local = points @ pose[:3, :3].T + pose[:3, 3]
    row_x, row_y = pinhole.projection_rows(local[local[:, 2] > 1e-3], intrinsics)
    return (row_x @ row_x.T + row_y @ row_y.T) / sigma**2


def _judged(
    pose: np.ndarray,
    points: np.ndarray,
    pixels: np.ndarray,
    weights: np.ndarray,
    intrinsics: np.ndarray,
    delta: float,
) -> tuple[float, np.ndarray, np.ndarray]:
    """The energy at `pose`, and what `residuals` gives."""
    error, local = residuals(pose, points, pixels, intrinsics)
    # A point behind the camera costs as much as one a thousand pixels away, so that the energy stays finite.
    size = np.minimum(np.hypot(error[:, 0], error[:, 1]), 1e3)
    return float(weights @ np.where(size <= delta, size * size, delta * (2.0 * size - delta))), error, local


def _gauss_newton_step(
    error: np.ndarray, local: np.ndarray, weights: np.ndarray, intrinsics: np.ndarray, delta: float
) -> np.ndarray:
    use = np.isfinite(error[:, 0])
    if not use.all():
        error, local, weights = error[use], local[use], weights[use]
    weights = weights * np.minimum(1.0, delta / np.maximum(np.hypot(error[:, 0], error[:, 1]), 1e-12))
    row_x, row_y = pinhole.projection_rows(local, intrinsics)
    hessian = (row_x * weights) @ row_x.T + (row_y * weights) @ row_y.T
    gradient = row_x @ (weights * error[:, 0]) + row_y @ (weights * error[:, 1])
    hessian[np.diag_indices(6)] += 1e-9 * np.trace(hessian) + 1e-12
    return np.asarray(-np.linalg.solve(hessian, gradient))
