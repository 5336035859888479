"""How sure a depth from pictures is: what image noise, the grid of planes and the width of windows leave.

At inverse depth `d(x)`, neighbour `j` shows at pixel `x` of the reference `W_j(x) = I_j(u_j(x, d(x)))`. In a window
around `x`, with means removed and the contrast adapted, the residual is `r_j = I - W_j` and its derivative by a common
shift of `d` is `g_j = grad I_j . du_j/dd`. The noise `n` of the reference's own pixels is in every `r_j = n - n_j`, so
that the residuals of several neighbours are no independent measurements. With all images of one noise `s`, least
squares over the window has

    var_photo(d) = s^2 sum_x ((sum_j g_j)^2 + sum_j g_j^2) / (sum_x sum_j g_j^2)^2,     s^2 = mean of r^2 / 2.

The regularisation spreads what one window knows over its surroundings: `POOL` independent windows' worth within `REACH`
windows. To it come the sub-plane fraction, which the parabola finds to `GRID` of a step between planes, and the place
of the window: its depth is that of a pixel within `PLACE` of its middle, which matters where depth is slanted. Within
half a window of a jump of depth a pixel may belong to either side (`JUMP` of the difference). Poses are as good as the
images allow, which `FLOOR` says in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.mapping.plane_sweep import NOISE, Photo, box

AGREES = 0.3
"""Least correlation of windows, damped by noise, at which a neighbour takes part: below it sees something else."""
POOL = 4.0
REACH = 5
GRID = 0.15
PLACE = 0.7
FLOOR = 0.05
JUMP = 0.3
NO_JUMP = 2.0
"""Steps between planes by which the surface may bend within half a window without a jump: what its noise makes
there."""


@dataclass(frozen=True, eq=False)
class Support:
    """sigma: float32 [H, W], standard deviation of the inverse depth, 1/m. views: int [H, W], in how many neighbours'
    pictures the pixel's point falls.
    """

    sigma: np.ndarray
    views: np.ndarray


def support(reference: Photo, others: Sequence[Photo], inverse_depth: np.ndarray, step: float, window: int) -> Support:
    """What the pictures say of each pixel's inverse depth.

    Args:
        reference: whose pixels are asked.
        others: its neighbours.
        inverse_depth: float32 [H, W], 1/m.
        step: between the planes that were searched, 1/m.
        window: width of the windows, pixels, odd.

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
        good = inside & (correlation > AGREES)
        gain = np.sqrt((own_variance + NOISE**2) / (variance + NOISE**2))
        rate = gain * (rate - box(rate, window))
        information += np.where(good, box(rate * rate, window), 0)
        squares += np.where(good, box((own - gain * centred) ** 2, window), 0)
        lever += np.where(inside, length, 0)
        common += np.where(good, rate, 0)
        agree += good
        views += inside
    noise = np.maximum(squares / np.maximum(agree, 1), NOISE**2) / 2
    spread = np.maximum(information + box(common * common, window), 1e-12)
    known = window**2 * np.maximum(information, 0) ** 2 / (noise * spread)
    photometric = 1.0 / np.maximum(known + POOL * box(known, REACH * window), 1e-12)
    slope = np.hypot(*(cv2.Scharr(inverse_depth, cv2.CV_32F, *axis) / 32 for axis in ((1, 0), (0, 1))))
    poses = FLOOR * views / np.maximum(lever, 1e-9)
    jump = JUMP * np.maximum(_bend(inverse_depth, window // 2) - NO_JUMP * step, 0)
    sigma = np.sqrt(photometric + (GRID * step) ** 2 + (PLACE * slope) ** 2 + jump**2 + poses**2)
    return Support(sigma.astype(np.float32), views.astype(np.int32))


def _bend(inverse_depth: np.ndarray, reach: int) -> np.ndarray:
    """By how much the inverse depth departs from a plane (on which it is affine) within `reach` pixels."""
    padded = cv2.copyMakeBorder(inverse_depth, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    middle = slice(reach, -reach)
    across = np.abs(padded[middle, 2 * reach :] - 2 * inverse_depth + padded[middle, : -2 * reach])
    along = np.abs(padded[2 * reach :, middle] - 2 * inverse_depth + padded[: -2 * reach, middle])
    bend: np.ndarray = cv2.dilate(np.maximum(across, along), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    return bend


def _seen(reference: Photo, other: Photo, inverse_depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each pixel: what `other` shows there (-1 outside), its derivative by the inverse depth, and by how many
    pixels the place moves; float32 [H, W] each.
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
    at_x, at_y = np.where(behind, -1e4, fx * u + cx), np.where(behind, -1e4, fy * v + cy)
    look = lambda image, outside: cv2.remap(
        image, at_x.astype(np.float32), at_y.astype(np.float32), cv2.INTER_LINEAR, borderValue=outside
    )
    slopes = [cv2.Scharr(other.grey, cv2.CV_32F, *axis) / 32 for axis in ((1, 0), (0, 1))]
    rate = look(slopes[0], 0) * along_x + look(slopes[1], 0) * along_y
    return look(other.grey, -1e4), rate, np.hypot(along_x, along_y)
