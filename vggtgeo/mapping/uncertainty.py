"""Uncertainty of stereo depth: image noise, discretisation by planes, and window size.

At inverse depth `d(x)`, neighbour `j` shows `W_j(x) = I_j(u_j(x, d(x)))` at pixel `x` of the reference. In a window
around `x`, after removing means and matching contrast, the residual is `r_j = I - W_j`, and its derivative with respect
to a common shift of `d` is `g_j = grad I_j . du_j/dd`. The noise `n` of the reference is in every `r_j = n - n_j`, so
that the residuals of several neighbours are correlated. If all images have noise `s`, least squares over the window
has the variance

    var_photo(d) = s^2 sum_x ((sum_j g_j)^2 + sum_j g_j^2) / (sum_x sum_j g_j^2)^2,     s^2 = mean of r^2 / 2.

The regularisation shares information between windows: that of `POOL` independent windows within `REACH` windows. Added
to it are the error of the sub-plane parabola (`GRID` steps between planes), of the position in the window to which its
depth belongs (`POSITION` pixels, times the slope of depth), of pixels within half a window of a depth edge, which may
belong to either side (`JUMP` times the difference), and of the poses (`POSE` pixels).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from vggtgeo.mapping.plane_sweep import NOISE, Photo, box

MIN_CORRELATION = 0.3
"""Of windows, with noise in the variances: neighbours below it are occluded."""
POOL = 4.0
REACH = 5
GRID = 0.15
POSITION = 0.7
POSE = 0.05
JUMP = 0.3
MAX_BEND = 2.0
"""Steps between planes by which noise bends the surface within half a window; more is a depth edge."""


def stereo_depth_sigma(
    reference: Photo, others: Sequence[Photo], inverse_depth: np.ndarray, step: float, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviation of each pixel's inverse depth, 1/m, and how many neighbours see its point, [H, W].

    Args:
        reference: image of the inverse depth.
        others: its neighbours.
        inverse_depth: float32 [H, W], 1/m.
        step: between the searched planes, 1/m.
        window: width of the correlation window, pixels, odd.

    """
    zero = np.zeros(reference.grey.shape, np.float32)
    common, information, squares, lever, agree, views = (zero.copy() for _ in range(6))
    own = reference.grey - box(reference.grey, window)
    own_variance = box(own * own, window)
    for other in others:
        warped, rate, length = _seen(reference, other, inverse_depth)
        inside = warped >= 0
        centred = np.where(inside, warped, 0) - box(np.where(inside, warped, 0), window)
        variance = box(centred * centred, window)
        correlation = box(own * centred, window) / np.sqrt((variance + NOISE**2) * (own_variance + NOISE**2))
        good = inside & (correlation > MIN_CORRELATION)
        gain = np.sqrt((own_variance + NOISE**2) / (variance + NOISE**2))
        rate = gain * (rate - box(rate, window))
        information += np.where(good, box(rate * rate, window), 0)
        squares += np.where(good, box((own - gain * centred) ** 2, window), 0)
        lever += np.where(inside, length, 0)
        common += np.where(good, rate, 0)
        agree += good
        views += inside
    # Half of the squared difference of two images is the variance of one.
    noise = np.maximum(squares / np.maximum(agree, 1), NOISE**2) / 2
    spread = np.maximum(information + box(common * common, window), 1e-12)
    known = window**2 * np.maximum(information, 0) ** 2 / (noise * spread)
    photometric = 1.0 / np.maximum(known + POOL * box(known, REACH * window), 1e-12)
    slope = np.hypot(*(cv2.Scharr(inverse_depth, cv2.CV_32F, *axis) / 32 for axis in ((1, 0), (0, 1))))
    poses = POSE * views / np.maximum(lever, 1e-9)
    jump = JUMP * np.maximum(_bend(inverse_depth, window // 2) - MAX_BEND * step, 0)
    sigma = np.sqrt(photometric + (GRID * step) ** 2 + (POSITION * slope) ** 2 + jump**2 + poses**2)
    return sigma.astype(np.float32), views.astype(np.int32)


def _bend(inverse_depth: np.ndarray, reach: int) -> np.ndarray:
    """Return the deviation of the inverse depth from a plane (on which it is affine) within `reach` pixels."""
    padded = cv2.copyMakeBorder(inverse_depth, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    middle = slice(reach, -reach)
    across = np.abs(padded[middle, 2 * reach :] - 2 * inverse_depth + padded[middle, : -2 * reach])
    along = np.abs(padded[2 * reach :, middle] - 2 * inverse_depth + padded[: -2 * reach, middle])
    bend: np.ndarray = cv2.dilate(np.maximum(across, along), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    return bend


def _seen(reference: Photo, other: Photo, inverse_depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the grey level of `other` at each pixel's point, its derivative, and the pixels moved; float32 [H, W]
    each.

    The grey level is below 0 outside. Derivative and motion are with respect to inverse depth.
    """
    height, width = inverse_depth.shape
    relative = (other.pose @ np.linalg.inv(reference.pose)).astype(np.float32)
    fx, fy, cx, cy = reference.intrinsics.astype(np.float32)
    x = ((np.arange(width, dtype=np.float32) - cx) / fx)[None, :]
    y = ((np.arange(height, dtype=np.float32) - cy) / fy)[:, None]
    move = relative[:3, 3]
    place = [row[0] * x + row[1] * y + row[2] + inverse_depth * row[3] for row in relative[:3]]
    behind = place[2] < 1e-3
    z = np.where(behind, 1, place[2])
    u, v = place[0] / z, place[1] / z
    fx, fy, cx, cy = other.intrinsics.astype(np.float32)
    along_x, along_y = fx * (move[0] - u * move[2]) / z, fy * (move[1] - v * move[2]) / z
    # Outside of the image, where `remap` reads the border value.
    at_x, at_y = np.where(behind, -1e4, fx * u + cx), np.where(behind, -1e4, fy * v + cy)
    look = lambda image, outside: cv2.remap(
        image, at_x.astype(np.float32), at_y.astype(np.float32), cv2.INTER_LINEAR, borderValue=outside
    )
    slopes = [cv2.Scharr(other.grey, cv2.CV_32F, *axis) / 32 for axis in ((1, 0), (0, 1))]
    rate = look(slopes[0], 0) * along_x + look(slopes[1], 0) * along_y
    return look(other.grey, -1e4), rate, np.hypot(along_x, along_y)
