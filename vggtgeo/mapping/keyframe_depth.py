"""Dense depth of the keyframes after the adjustment: corrected by the adjusted points, averaged over keyframes.

In the adjustment, the depth prior of a pixel without a key point has no other residual: its optimum is the prior. The
corrections of the key points (`log z_adjusted - log z_prior`) are therefore interpolated by a bilateral grid (Chen,
Paris, Durand 2007) over image position and log depth, which smooths along surfaces and stops at depth edges.

Errors of a depth network vary slowly within an image and change between keyframes, while relative poses of neighbours
are accurate. So each depth map is averaged with its neighbours', corrected again by the key points, and averaged again.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.mapping.depth_map import COMPRESS_FROM
from vggtgeo.slam.sparse_map.keyframe import CompressedImage, Keyframe, array_of
from vggtgeo.slam.threads import map_in_threads

CELL = 24.0
"""Pixels per grid cell."""
DEPTH_CELL = 0.08
"""Log depth per grid cell."""
MAX_CORRECTION = 0.2
"""Of log depth: a larger one is a mismatch."""
OFFSETS = (1, 2, 3, 4, 6, 8, 10, 12)
"""Neighbours before and after, in keyframes: near ones overlap most, far ones have independent errors."""
STEP = 4
"""Pixels between the points that a neighbour contributes, and width of the cells that collect them."""
SMOOTHING = 1.0
"""Standard deviation of the smoothing, cells."""
MAX_DIFFERENCE = 0.15
"""Of log depth: a larger one is another surface."""
MIN_MASS = 0.35
"""Smoothed number of a neighbour's points in a cell needed to use it there."""
ROUNDS = 2
"""Of correction by key points and averaging over keyframes."""
PRIOR_WEIGHT = 0.02
"""Of a zero correction in each grid cell: far from all key points the depth stays."""


def optimised_depth(keyframe: Keyframe, depth: np.ndarray) -> np.ndarray:
    """Return `depth` corrected by the adjusted key points; both float32 `[H, W]`, metres, NaN = unknown."""
    log_depth = np.log(depth)
    pixels, correction, weight = _corrections(keyframe, log_depth)
    if not len(pixels):
        return depth
    height, width = depth.shape
    low = float(np.nanmin(log_depth))
    shape = (
        int(height / CELL) + 3,
        int(width / CELL) + 3,
        int((float(np.nanmax(log_depth)) - low) / DEPTH_CELL) + 3,
    )
    columns, rows = np.rint(pixels).astype(int).T
    at = np.stack([pixels[:, 1] / CELL, pixels[:, 0] / CELL, (log_depth[rows, columns] - low) / DEPTH_CELL])
    cell = tuple(np.rint(at).astype(int) + 1)
    mass, moment = np.zeros(shape), np.zeros(shape)
    np.add.at(mass, cell, weight)
    np.add.at(moment, cell, weight * correction)
    # Blur mass and moment alike and divide (homogeneous coordinates of the bilateral grid): empty cells do not count as
    # 0.
    mass, moment = (gaussian_filter(grid, 1.0, mode="constant") for grid in (mass, moment))
    return depth * np.exp(_slice(moment / (mass + PRIOR_WEIGHT), (log_depth - low) / DEPTH_CELL + 1))


def _slice(field: np.ndarray, layer: np.ndarray) -> np.ndarray:
    """Interpolate `field` [h, w, d] at every pixel and its `layer` [H, W]; float32 [H, W], NaN where `layer` is.

    Trilinear: `cv2.remap` interpolates in an image of all layers below each other, in the two layers at each pixel.
    """
    rows, columns, layers = field.shape
    image = np.ascontiguousarray(field.transpose(2, 0, 1), np.float32).reshape(layers * rows, columns)
    with np.errstate(invalid="ignore"):
        below = np.nan_to_num(np.floor(layer)).clip(0, layers - 2)
    height, width = layer.shape
    x = np.broadcast_to(np.arange(width, dtype=np.float32) / CELL + 1, layer.shape)
    y = below * rows + (np.arange(height, dtype=np.float32) / CELL + 1)[:, None]
    x, y = np.ascontiguousarray(x, np.float32), y.astype(np.float32)
    first, second = (cv2.remap(image, x, y + rows * up, cv2.INTER_LINEAR) for up in (np.float32(0), np.float32(1)))
    return np.asarray(first + (layer - below) * (second - first))


def _corrections(keyframe: Keyframe, log_depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels, log depth corrections and weights of the key points that have both an estimate and a prior."""
    slots = keyframe.points
    height, width = log_depth.shape
    here = pinhole.at_pixels(log_depth, slots.pixels)
    inside = np.all((slots.pixels > -0.5) & (slots.pixels < (width - 0.5, height - 0.5)), axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        estimate = -np.log(slots.inverse_depth)
        correction = estimate - here
        # Exactly at its prior, a key point has taken no part in an adjustment.
        adjusted = estimate != -np.log(slots.prior_mean)
    good = inside & np.isfinite(correction) & adjusted & (np.abs(correction) < MAX_CORRECTION)
    return slots.pixels[good], correction[good], slots.confidence[good] * slots.prior_confidence[good]


def fused_depths(keyframes: Sequence[Keyframe], intrinsics: np.ndarray) -> list[np.ndarray | CompressedImage | None]:
    """Return the dense depth of each keyframe, corrected by its key points and averaged with its neighbours'.

    Args:
        keyframes: in order of time; poses world -> camera.
        intrinsics: float64 [4], pixels.

    Returns:
        float32 [H, W] metres per keyframe, NaN where unknown, compressed if there are many; None without depth.

    """
    many = len(keyframes) >= COMPRESS_FROM
    stored = lambda depth: CompressedImage.of(depth.astype(np.float16)) if many else depth

    def measured(keyframe: Keyframe) -> np.ndarray | CompressedImage | None:
        return keyframe.images.depth if keyframe.images.has_depth else None

    def correct(i: int) -> np.ndarray | None:
        """Correct a depth map in place; return its points."""
        if (depth := depths[i]) is None:
            return None
        corrected = optimised_depth(keyframes[i], array_of(depth).astype(np.float32))
        depths[i] = stored(corrected)
        return _points(corrected, intrinsics)

    def average(i: int) -> None:
        if (depth := depths[i]) is not None:
            neighbours = _neighbours(clouds, keyframes, i)
            depths[i] = stored(_averaged(array_of(depth).astype(np.float32), neighbours, intrinsics))

    depths, numbers = map_in_threads(measured, keyframes), range(len(keyframes))
    for _ in range(ROUNDS):
        clouds = map_in_threads(correct, numbers)
        map_in_threads(average, numbers)
    return depths


def _neighbours(
    clouds: Sequence[np.ndarray | None], keyframes: Sequence[Keyframe], i: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return points of the neighbours that have any, with the motion from each to keyframe i."""
    numbers = [i + sign * offset for offset in OFFSETS for sign in (-1, 1)]
    return [
        (cloud, keyframes[i].pose @ rigid.invert(keyframes[j].pose))
        for j in numbers
        if 0 <= j < len(clouds) and (cloud := clouds[j]) is not None
    ]


def _points(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return sampled points of a depth map in the camera frame, float32 [3, n], metres."""
    rows, columns = np.mgrid[STEP // 2 : depth.shape[0] : STEP, STEP // 2 : depth.shape[1] : STEP].reshape(2, -1)
    z = depth[rows, columns]
    known = np.isfinite(z)
    pixels = np.column_stack([columns[known], rows[known]]).astype(np.float32)
    return np.ascontiguousarray((pinhole.rays(pixels, intrinsics) * z[known, None]).T, np.float32)


def _averaged(depth: np.ndarray, others: list[tuple[np.ndarray, np.ndarray]], intrinsics: np.ndarray) -> np.ndarray:
    """Return the depth corrected by the mean difference to other keyframes; others: see `_neighbours`."""
    height, width = depth.shape
    cells = (-(-height // STEP), -(-width // STEP))
    total, views = np.zeros(cells), np.ones(cells)  # the keyframe's own view counts as one, with correction 0
    for points, motion in others:
        # Single precision suffices for relative motions, however far the keyframes are from the origin.
        relative = motion.astype(np.float32)
        local = relative[:3, :3] @ points + relative[:3, 3:]
        inside, rows, columns = pinhole.visible(local.T, intrinsics, (height, width))
        difference = np.log(local[2, inside] / depth[rows, columns])
        same = np.abs(difference) < MAX_DIFFERENCE  # false where the depth is NaN
        cell = (rows[same] // STEP) * cells[1] + columns[same] // STEP
        mass, moment = (_smoothed(cell, weights, cells) for weights in (None, difference[same]))
        seen = mass > MIN_MASS
        total[seen] += moment[seen] / mass[seen]
        views[seen] += 1
    # Corrections are smooth, depth is not: only the correction is upsampled, so that edges stay sharp.
    correction = cv2.resize((total / views).astype(np.float32), (cells[1] * STEP, cells[0] * STEP))
    return depth * np.exp(correction[:height, :width])


def _smoothed(cell: np.ndarray, weights: np.ndarray | None, cells: tuple[int, int]) -> np.ndarray:
    grid = np.bincount(cell, weights, cells[0] * cells[1]).reshape(cells).astype(np.float32)
    return cv2.GaussianBlur(grid, (0, 0), SMOOTHING, borderType=cv2.BORDER_CONSTANT)
