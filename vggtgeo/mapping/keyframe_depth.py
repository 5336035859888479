"""Dense depth of the keyframes after optimisation: what the slots learnt, and what other keyframes saw.

The depth prior of a pixel touches that pixel alone, so a pixel that carries no slot has its optimum at its prior: the
dense problem is solved by the slots. What the slots learnt (`log z_optimised - log z_prior`) is spread to their
neighbours by a bilateral grid (Chen, Paris, Durand 2007) over image position and log depth: it follows surfaces and
stops at depth edges.

The depth of a network errs smoothly over a picture and differently a second later, and so does what no slot reaches.
The other keyframes' views of a surface have errors of their own, and the poses between neighbours are known far better:
so each depth is averaged with its neighbours' in its own view, the slots corrected once more against that mean, and the
result averaged again.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from vggtgeo.geometry import rigid
from vggtgeo.mapping.depth_map import MANY
from vggtgeo.models import pinhole
from vggtgeo.slam.sparse_map.keyframe import Keyframe, read_at
from vggtgeo.slam.sparse_map.keyframe_images import CompressedImage, array_of
from vggtgeo.slam.threads import map_in_threads

CELL = 24.0
"""Pixels a grid cell."""
DEPTH_CELL = 0.08
"""Log depth a grid cell."""
LARGEST_CORRECTION = 0.2
"""Of log depth: what differs more is a mismatch, not a correction."""
OFFSETS = (1, 2, 3, 4, 6, 8, 10, 12)
"""Neighbours before and after, in keyframes: some near, which see the same, and some far, which err differently."""
STEP = 4
"""Pixels between the points that a neighbour contributes, and of a cell in which their corrections are collected."""
SPREAD = 1.0
"""Standard deviation of the smoothing over cells."""
GATE = 0.15
"""Largest difference of log depth: what differs more is another surface."""
LEAST_MASS = 0.35
"""Smoothed number of points in a cell below which a neighbour says nothing there."""
ROUNDS = 2
"""Of correction by slots and averaging over views."""


def optimised_depth(keyframe: Keyframe, depth: np.ndarray | None = None) -> np.ndarray:
    """Depth of every pixel that has a metric prior, corrected by the slots; float32 `[H, W]` metres, NaN = none.

    depth: what is corrected, float32 `[H, W]`; by default the prior.
    """
    depth = keyframe.depth.astype(np.float32) if depth is None else depth
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
    mass, moment = (gaussian_filter(grid, 1.0, mode="constant") for grid in (mass, moment))
    # A weak pull towards no correction: far from any slot the prior stands.
    return depth * np.exp(_sliced(moment / (mass + 0.02), (log_depth - low) / DEPTH_CELL + 1))


def _sliced(field: np.ndarray, layer: np.ndarray) -> np.ndarray:
    """`field` [h, w, d] at every pixel, float32 [H, W], by its place in the grid and its `layer` [H, W], NaN = NaN.

    Trilinear: the layers stand one below the other in one image, in which the two that enclose a pixel are looked up.
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
    """Pixels, log depth corrections and weights of the slots that have both an estimate and a prior."""
    slots = keyframe.points
    height, width = log_depth.shape
    here = read_at(log_depth, slots.pixels)
    inside = np.all((slots.pixels > -0.5) & (slots.pixels < (width - 0.5, height - 0.5)), axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        estimate = -np.log(slots.inverse_depth)
        correction = estimate - here
        # A slot that stands at its prior has taken no part in an adjustment.
        adjusted = estimate != -np.log(slots.prior)
    good = inside & np.isfinite(correction) & adjusted & (np.abs(correction) < LARGEST_CORRECTION)
    return slots.pixels[good], correction[good], slots.confidence[good] * slots.prior_confidence[good]


def fused_depths(keyframes: Sequence[Keyframe], intrinsics: np.ndarray) -> list[np.ndarray | CompressedImage | None]:
    """Dense depth of each keyframe, corrected by its slots and averaged with its neighbours' views.

    Args:
        keyframes: in the order of time; poses world -> camera.
        intrinsics: float64 [4], pixels.

    Returns:
        float32 [H, W] metres for each keyframe, NaN where it has no depth, of many keyframes compressed; None where it
        has none at all.

    """
    many = len(keyframes) >= MANY
    held = lambda depth: CompressedImage.of(depth.astype(np.float16)) if many else depth

    def measured(keyframe: Keyframe) -> np.ndarray | CompressedImage | None:
        return keyframe.images.depth if keyframe.images.has_depth else None

    def correct(i: int) -> np.ndarray | None:
        """Its points, once it is corrected."""
        if (depth := depths[i]) is None:
            return None
        corrected = optimised_depth(keyframes[i], array_of(depth).astype(np.float32))
        depths[i] = held(corrected)
        return _points(corrected, intrinsics)

    def average(i: int) -> None:
        if (depth := depths[i]) is not None:
            around = _around(clouds, keyframes, i)
            depths[i] = held(_averaged(array_of(depth).astype(np.float32), around, intrinsics))

    depths, numbers = map_in_threads(measured, keyframes), range(len(keyframes))
    for _ in range(ROUNDS):
        clouds = map_in_threads(correct, numbers)
        map_in_threads(average, numbers)
    return depths


def _around(
    clouds: Sequence[np.ndarray | None], keyframes: Sequence[Keyframe], i: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The neighbours' points, of those that have any, each with the motion from there to keyframe i."""
    numbers = [i + sign * offset for offset in OFFSETS for sign in (-1, 1)]
    return [
        (cloud, keyframes[i].pose @ rigid.invert(keyframes[j].pose))
        for j in numbers
        if 0 <= j < len(clouds) and (cloud := clouds[j]) is not None
    ]


def _points(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """What a keyframe contributes elsewhere, in its own frame: float32 [3, n], metres."""
    rows, columns = np.mgrid[STEP // 2 : depth.shape[0] : STEP, STEP // 2 : depth.shape[1] : STEP].reshape(2, -1)
    z = depth[rows, columns]
    known = np.isfinite(z)
    pixels = np.column_stack([columns[known], rows[known]]).astype(np.float32)
    return np.ascontiguousarray((pinhole.rays(pixels, intrinsics) * z[known, None]).T, np.float32)


def _averaged(depth: np.ndarray, others: list[tuple[np.ndarray, np.ndarray]], intrinsics: np.ndarray) -> np.ndarray:
    """The depth after the mean of what other keyframes measured of it; others: see `_around`."""
    height, width = depth.shape
    cells = (-(-height // STEP), -(-width // STEP))
    total, views = np.zeros(cells), np.ones(cells)  # the keyframe's own view, with no correction, counts as one
    for points, motion in others:
        # In single precision, and by the motion between the two: far from the origin it loses nothing.
        near = motion.astype(np.float32)
        local = near[:3, :3] @ points + near[:3, 3:]
        inside, rows, columns = pinhole.visible(local.T, intrinsics, (height, width))
        difference = np.log(local[2, inside] / depth[rows, columns])
        same = np.abs(difference) < GATE  # false where the depth is NaN
        cell = (rows[same] // STEP) * cells[1] + columns[same] // STEP
        mass, moment = (_smoothed(cell, weights, cells) for weights in (None, difference[same]))
        seen = mass > LEAST_MASS
        total[seen] += moment[seen] / mass[seen]
        views[seen] += 1
    correction = cv2.resize((total / views).astype(np.float32), (cells[1] * STEP, cells[0] * STEP))
    return depth * np.exp(correction[:height, :width])


def _smoothed(cell: np.ndarray, weights: np.ndarray | None, cells: tuple[int, int]) -> np.ndarray:
    grid = np.bincount(cell, weights, cells[0] * cells[1]).reshape(cells).astype(np.float32)
    return cv2.GaussianBlur(grid, (0, 0), SPREAD, borderType=cv2.BORDER_CONSTANT)
