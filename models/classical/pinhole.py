"""The ideal pinhole: a few lines that several roles share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def intrinsics_matrix(intrinsics: Sequence[float] | np.ndarray) -> np.ndarray:
    """K, float64 [3, 3], of (fx, fy, cx, cy)."""
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def project(points: np.ndarray, pose: np.ndarray, intrinsics: Sequence[float] | np.ndarray) -> np.ndarray:
    """Pixels float [n, 2] of world points [n, 3] under `pose` (world -> camera); NaN where not in front."""
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)
    return np.stack([fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy], axis=1)


def back_project(pixels: np.ndarray, depth: np.ndarray, intrinsics: Sequence[float] | np.ndarray) -> np.ndarray:
    """Points float [n, 3] in the camera's frame of pixels [n, 2] with depth [n] in metres."""
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    return np.stack(
        [(pixels[:, 0] - cx) / fx * depth, (pixels[:, 1] - cy) / fy * depth, depth],
        axis=1,
    )
