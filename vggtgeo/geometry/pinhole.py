"""The ideal pinhole in numpy: rays of pixels and projection of points. `camera_models.py` has it for JAX.

Intrinsics are `(fx, fy, cx, cy)` in pixels, pixel (0, 0) is the centre of the top-left pixel, camera axes are x right,
y down, z forward (Hartley and Zisserman 2004, section 6.1). Results keep the floating type of points and depths.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

IntrinsicsLike = Sequence[float] | np.ndarray


def matrix(intrinsics: IntrinsicsLike) -> np.ndarray:
    """Return the calibration matrix K, float64 [3, 3]."""
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def rays(pixels: np.ndarray, intrinsics: IntrinsicsLike) -> np.ndarray:
    """Return the viewing rays with z = 1, float [..., 3], of pixels [..., 2]."""
    focal, centre = _split(intrinsics, pixels.dtype)
    flat = (pixels - centre) / focal
    return np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)


def grid_rays(shape: tuple[int, int], intrinsics: IntrinsicsLike, dtype: type[np.floating] = np.float64) -> np.ndarray:
    """Return the viewing rays with z = 1 of all pixels of an image of `shape` (height, width), [h, w, 3]."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return rays(np.stack([columns, rows], axis=-1).astype(dtype), intrinsics)


def project(points: np.ndarray, intrinsics: IntrinsicsLike, nearest: float = 1e-3) -> np.ndarray:
    """Return the pixels [..., 2] of points [..., 3] in the camera's frame, NaN where z <= `nearest` (metres)."""
    focal, centre = _split(intrinsics, points.dtype)
    z = np.where(points[..., 2] > nearest, points[..., 2], np.nan)
    pixels = np.empty((*z.shape, 2), np.result_type(points, focal))
    for axis in (0, 1):  # numpy takes three times as long for pairs at once
        pixels[..., axis] = points[..., axis] / z * focal[axis] + centre[axis]
    return pixels


def epipolar_distance(
    pixels_i: np.ndarray, pixels_j: np.ndarray, motion: np.ndarray, intrinsics: IntrinsicsLike
) -> np.ndarray:
    """Return the distances of `pixels_j` [n, 2] from the epipolar lines of `pixels_i`, float64 [n], pixels.

    motion: i -> j, [4, 4]. Pixels must be square. Without translation there are no lines, and distances are 0.
    """
    essential = np.cross(motion[:3, 3], motion[:3, :3].T).T  # [t]x R: Hartley and Zisserman 2004, section 9.6
    lines = rays(np.asarray(pixels_i, np.float64), intrinsics) @ essential.T
    lever = np.linalg.norm(lines[:, :2], axis=1)
    off = np.abs((lines * rays(np.asarray(pixels_j, np.float64), intrinsics)).sum(1))
    focal = float(intrinsics[0])
    # Without translation every pixel is consistent with every other.
    return np.where(lever < 1e-9, 0.0, off / np.maximum(lever, 1e-12) * focal)


def visible(
    points: np.ndarray, intrinsics: IntrinsicsLike, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which points [n, 3] in the camera's frame are inside an image of `shape` (height, width), bool [n].

    Also returns row and column of those points, int. Nothing is visible nearer than 0.1 m, as to depth sensors.
    """
    with np.errstate(invalid="ignore"):
        x, y = np.ascontiguousarray(np.rint(project(points, intrinsics, 0.1)).T)
        inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
    return inside, y[inside].astype(int), x[inside].astype(int)


def at_pixels(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the values [m, ...] of an image [h, w, ...] at the pixels nearest to `pixels` [m, 2], inside or not."""
    column, row = np.clip(np.rint(pixels), 0, np.array(image.shape[1::-1]) - 1).astype(int).T
    return np.asarray(image[row, column])


def coarser(intrinsics: IntrinsicsLike, factor: int) -> np.ndarray:
    """Return the intrinsics, float64 [4], of an image whose pixels are blocks of `factor` x `factor` pixels."""
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    middle = 0.5 * (factor - 1)  # the centre of the first block, in pixels of the fine image
    return np.array([fx, fy, cx - middle, cy - middle]) / factor


def projection_rows(points: np.ndarray, intrinsics: IntrinsicsLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of the pixel's x and y by the left tangent of the pose, [6, n] each, translation first.

    points: [n, 3] in the camera's frame, in front of it.
    """
    (fx, fy), _ = _split(intrinsics, points.dtype)
    x, y, z = points.T
    zero, u, v = np.zeros_like(x), x / z, y / z
    row_x = fx * np.stack([1 / z, zero, -u / z, -u * v, 1 + u * u, -v])
    row_y = fy * np.stack([zero, 1 / z, -v / z, -1 - v * v, u * v, u])
    return row_x, row_y


def _split(intrinsics: IntrinsicsLike, dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Return focal lengths and principal point, [2] each, in `dtype` (float64 for integer pixels)."""
    values = np.asarray(intrinsics, dtype if np.issubdtype(dtype, np.floating) else np.float64)
    return values[:2], values[2:]
