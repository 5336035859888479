"""Data of one image for the direct RGB-D alignment: a pyramid of brightness, surface points, edge points."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.robust import TINY

WIDTH = 300
"""Images are reduced by a whole factor to about this width for the brightness, pixels: about half of VGA."""
LEVELS = 3
"""Of the image pyramid: the coarsest has 1/16 of the pixels."""
BACKGROUND = 6.0
"""Standard deviation of the blur whose result is subtracted as local mean, pixels of each level: it changes with
exposure and shading."""
BLOCK = 2
"""Side of a depth cell, reduced pixels: the mean is less noisy than one pixel."""
MAX_STEP = 0.1
"""Relative difference of depth between the neighbours of a cell above which they are on different surfaces: a floor
that is seen at a flat angle stays below it."""
EDGE_CELL = 4
"""Side of a cell for edge samples, reduced pixels: the pixel with the strongest gradient is used."""
FAINT = 1.5
"""Minimum gradient, grey levels a pixel; weaker ones are image noise."""
MAX_POINTS, MAX_EDGES = 2400, 3600
"""Surface and edge points of the source; more cost time and change nothing, since they share their errors."""
PIXELS_AT_ONCE = 16384
CELLS_AT_ONCE = PIXELS_AT_ONCE // BLOCK**2
"""Tables are padded to a multiple of so many rows, of pixels a fifth of VGA's: the alignment is compiled for few image
sizes."""


@dataclass(frozen=True, eq=False)
class Points:
    """Samples of a view in columns, of which the first `count` are valid.

    points: float32 [3, n] in the camera frame, metres. values: [k, n], further data of each: of a surface the unit
    normal towards the camera and the standard deviation of the depth, metres; of an edge the brightness in each level.
    """

    points: np.ndarray
    values: np.ndarray
    count: int

    @classmethod
    def of(cls, points: np.ndarray, values: np.ndarray, room: int) -> Points:
        """Pack samples, one a column, into `room` columns."""
        count = points.shape[1]
        padded = np.zeros((3 + len(values), room), np.float32)
        padded[:3, :count], padded[3:, :count] = points, values
        return cls(padded[:3], padded[3:], count)

    @classmethod
    def none(cls, known: int, room: int) -> Points:
        """Return no samples, with `known` further values."""
        return cls.of(np.zeros((3, 0)), np.zeros((known, 0)), room)


@dataclass(frozen=True, eq=False)
class RgbdView:
    """Data of one image for an alignment.

    picture: float32 [p, 3], brightness without its local mean and its derivatives by x and y, all levels one after the
    other, the finest first, row by row. cells: [c, 7] of the depth image, row by row: the point in the camera frame,
    metres, the unit normal towards the camera, and the standard deviation of the depth, metres; normal zero = unknown.
    sizes: int32 [levels + 1, 3], width and height of each level and its first row; the last is that of the cells.
    intrinsics: [levels + 1, 4] of the same. surface: cells spread over the image. edges: points with a strong gradient.
    """

    picture: np.ndarray
    cells: np.ndarray
    sizes: np.ndarray
    intrinsics: np.ndarray
    surface: Points
    edges: Points

    @classmethod
    def of(cls, image: np.ndarray, depth: tuple[np.ndarray, np.ndarray] | None, intrinsics: np.ndarray) -> RgbdView:
        """Compute the view of an image uint8 [H, W, 3] with depth float [H, W], metres, NaN = unknown, and its relative
        sigma.
        """
        factor = max(round(image.shape[1] / WIDTH), 1)
        gray = _shrink(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), factor)
        levels = _pyramid(gray)
        coarse = pinhole.coarser(intrinsics, factor * BLOCK)
        cameras = [*(pinhole.coarser(intrinsics, factor * 2**level) for level in range(LEVELS)), coarse]
        shape, cells = (0, 0), np.zeros((0, 7), np.float32)
        surface, edges = Points.none(4, MAX_POINTS), Points.none(LEVELS, MAX_EDGES)
        if depth is not None and np.isfinite(depth[0]).any():
            z, sigma = _cell_means(*depth, factor * BLOCK)
            points = pinhole.grid_rays(z.shape, coarse, np.float32) * z[..., None]
            normals = surface_normals(points)
            shape, cells = z.shape, _cells(points, normals, sigma)
            surface, edges = _spread(cells), _edge_samples(levels, z, cameras[0])
        picture = np.concatenate([level.reshape(-1, 3) for level in levels])
        ends = np.cumsum([0, *(level.shape[0] * level.shape[1] for level in levels)])
        sides = [*((level.shape[1], level.shape[0]) for level in levels), (shape[1], shape[0])]
        sizes = np.array([(*side, begin) for side, begin in zip(sides, (*ends[:-1], 0), strict=True)], np.int32)
        table = np.array(cameras, np.float32)
        return cls(_padded(picture, PIXELS_AT_ONCE), _padded(cells, CELLS_AT_ONCE), sizes, table, surface, edges)


def _padded(rows: np.ndarray, step: int) -> np.ndarray:
    """Return the table padded with zeros, at least one row: samples out of view read valid rows."""
    count = (len(rows) // step + 1) * step
    return np.concatenate([rows, np.zeros((count - len(rows), rows.shape[1]), np.float32)])


def _shrink(image: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return image
    return cv2.resize(image, (image.shape[1] // factor, image.shape[0] // factor), interpolation=cv2.INTER_AREA)


def _pyramid(gray: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return brightness without its local mean, and its derivatives by x and y, float32 [h, w, 3] of each level."""
    levels = []
    for level in range(LEVELS):
        image = _shrink(gray, 2**level)
        # A high-pass filter, since exposure and shading change the mean.
        value = image - cv2.GaussianBlur(image, (0, 0), BACKGROUND)
        # The weights of Scharr's kernel, times their distances, sum to 32.
        dx, dy = (cv2.Scharr(value, cv2.CV_32F, axis, 1 - axis, scale=1 / 32) for axis in (1, 0))
        levels.append(cv2.merge([value, dx, dy]))
    return tuple(levels)


def _cell_means(depth: np.ndarray, sigma: np.ndarray, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth at the mean inverse depth of blocks and its sigma, metres, float32 [h, w].

    NaN if half of a block is unknown, or across a depth edge. Neighbouring pixels share their errors (smoothing,
    interpolation), so the sigma of a block is that of one pixel.
    """
    height, width = depth.shape[0] // factor * factor, depth.shape[1] // factor * factor
    depth = np.ascontiguousarray(depth[:height, :width], np.float32)
    known = np.isfinite(depth)
    inverse = _zero_where(~known, 1.0 / depth)
    size = (width // factor, height // factor)
    # Holes count as zeros in both means, so dividing by the share of known pixels removes them.
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    mean, square = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (inverse, inverse * inverse))
    safe = np.maximum(share, TINY)
    mean, square = mean / safe, square / safe
    spread = np.sqrt(np.maximum(square - mean * mean, 0.0))
    # A block across a depth jump has a mean on neither surface. Half of it on either side: the standard deviation is
    # half of the step.
    good = (share >= 0.5) & (spread < MAX_STEP / 2 * mean)
    cells = np.where(good, 1.0 / np.maximum(mean, TINY), np.nan).astype(np.float32)
    noise = _zero_where(~known, np.array(sigma[:height, :width], np.float32))
    return cells, cells * cv2.resize(noise, size, interpolation=cv2.INTER_AREA) / safe


def _zero_where(unknown: np.ndarray, image: np.ndarray) -> np.ndarray:
    image[unknown] = 0.0
    return image


def surface_normals(points: np.ndarray) -> np.ndarray:
    """Return unit normals towards the camera by central differences, NaN at borders, holes and depth edges."""
    normals = np.full_like(points, np.nan)
    if min(points.shape[:2]) < 3:
        return normals
    right = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = rigid.cross(down, right)
    z = points[1:-1, 1:-1, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        # A difference across a depth edge is no tangent of either surface.
        smooth = (np.abs(right[..., 2]) < MAX_STEP * z) & (np.abs(down[..., 2]) < MAX_STEP * z)
        normal = normal / np.linalg.norm(normal, axis=2, keepdims=True)
    normals[1:-1, 1:-1] = np.where(smooth[..., None], normal, np.nan)
    return normals


def _cells(points: np.ndarray, normals: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    known = np.isfinite(normals[..., :1])
    return np.where(known, np.concatenate([points, normals, sigma[..., None]], 2), np.float32(0)).reshape(-1, 7)


def _spread(cells: np.ndarray) -> Points:
    """Return at most `MAX_POINTS` cells with a surface, evenly spread."""
    known = np.flatnonzero(cells[:, 3:6].any(axis=1))
    # A fixed shuffle: a regular stride would take whole columns of the grid.
    order = np.random.default_rng(0).permutation(len(known))[:MAX_POINTS]
    chosen = cells[np.sort(known[order])].T
    return Points.of(chosen[:3], chosen[3:], MAX_POINTS)


def _edge_samples(levels: tuple[np.ndarray, ...], cells: np.ndarray, intrinsics: np.ndarray) -> Points:
    """Return the strongest gradient of each cell of known depth, at most `MAX_EDGES` of them, and the brightness there.

    cells: depth, [h, w]. intrinsics: of the finest level.
    """
    finest = levels[0]
    strength = cv2.magnitude(*(np.ascontiguousarray(finest[..., side]) for side in (1, 2)))
    # One sample a cell spreads them over the image, as a detailed object would otherwise take them all.
    height, width = (side // EDGE_CELL * EDGE_CELL for side in strength.shape)
    blocks = strength[:height, :width].reshape(height // EDGE_CELL, EDGE_CELL, width // EDGE_CELL, EDGE_CELL)
    flat = blocks.transpose(0, 2, 1, 3).reshape(height // EDGE_CELL, width // EDGE_CELL, -1)
    place = flat.argmax(2)
    row = np.arange(height // EDGE_CELL)[:, None] * EDGE_CELL + place // EDGE_CELL
    column = np.arange(width // EDGE_CELL)[None, :] * EDGE_CELL + place % EDGE_CELL
    row, column = row.ravel(), column.ravel()
    z = cells[np.minimum(row // BLOCK, cells.shape[0] - 1), np.minimum(column // BLOCK, cells.shape[1] - 1)]
    inner = (row > 2) & (column > 2) & (row < strength.shape[0] - 3) & (column < strength.shape[1] - 3)
    good = np.flatnonzero(np.isfinite(z) & (strength[row, column] > FAINT) & inner)
    if len(good) > MAX_EDGES:
        weakest_last = np.argsort(-strength[row[good], column[good]], kind="stable")
        good = np.sort(good[weakest_last[:MAX_EDGES]])
    row, column, z = row[good], column[good], z[good]
    pixels = np.column_stack([column, row]).astype(np.float64)
    points = pinhole.rays(pixels, intrinsics) * z[:, None]
    values = np.zeros((LEVELS, len(good)), np.float32)
    for number, level in enumerate(levels):
        # Pixel centres are integers, so the image begins at -0.5 at every level.
        x, y = ((pixels + 0.5) / 2**number - 0.5).astype(np.float32).T
        value = np.ascontiguousarray(level[..., 0])
        if len(x):
            values[number] = cv2.remap(value, x[None], y[None], cv2.INTER_LINEAR)[0]
    return Points.of(points.T, values, MAX_EDGES)
