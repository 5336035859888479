"""What the direct alignment of two RGB-D images needs of each: a pyramid of brightness, surface points, edge points."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole

WIDTH = 300
"""Images are shrunk by a whole factor to about so many pixels for the brightness."""
LEVELS = 3
BACKGROUND = 6.0
"""Standard deviation of the local mean that is taken off, pixels of each level: exposure and shading change it."""
BLOCK = 2
"""Cells of the depth, in shrunk pixels a side: their mean is less noisy than one pixel."""
EDGE_CELL = 4
"""One brightness sample, the one with the strongest gradient, is taken of each such cell, shrunk pixels a side."""
FAINT = 1.5
"""Grey levels a pixel; a weaker gradient is noise of the image."""
MOST_POINTS = 2400
"""Surface points of the source that take part; more cost time and change nothing, for they share their errors."""


@dataclass(frozen=True, eq=False)
class Gray:
    """One level. image: float32 [h, w, 3], brightness without its local mean and its derivatives by x and y."""

    image: np.ndarray
    intrinsics: np.ndarray


@dataclass(frozen=True, eq=False)
class Surface:
    """Cells of an image with depth. cells: float32 [7, h w], the point in the camera frame, metres, the unit normal
    towards the camera, and the standard deviation of the depth, metres; normal zero = none. shape: h, w.
    """

    cells: np.ndarray
    shape: tuple[int, int]
    intrinsics: np.ndarray


@dataclass(frozen=True, eq=False)
class Samples:
    """Cells spread over the image: points float32 [3, n], normals [3, n], standard deviations of the depth [n]."""

    points: np.ndarray
    normals: np.ndarray
    sigma: np.ndarray

    def every(self, step: int) -> Samples:
        """Each `step`-th."""
        if step == 1:
            return self
        return Samples(*(np.ascontiguousarray(rows[..., ::step]) for rows in (self.points, self.normals, self.sigma)))


@dataclass(frozen=True, eq=False)
class RgbdView:
    """What an alignment needs of one image.

    levels: finest first. edges: float32 [3, m] points in the camera frame with a strong gradient, metres, and
    edge_values: one float32 [m] of brightness for each level.
    """

    levels: tuple[Gray, ...]
    surface: Surface
    samples: Samples
    edges: np.ndarray
    edge_values: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, image: np.ndarray, depth: tuple[np.ndarray, np.ndarray] | None, intrinsics: np.ndarray) -> RgbdView:
        """From an image uint8 [H, W, 3], its depth float [H, W], metres, NaN = none, and that one's relative sigma."""
        factor = max(round(image.shape[1] / WIDTH), 1)
        gray = _shrink(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), factor)
        levels = _pyramid(gray, pinhole.coarser(intrinsics, factor))
        coarse = pinhole.coarser(intrinsics, factor * BLOCK)
        if depth is None or not np.isfinite(depth[0]).any():
            none, empty = np.zeros((3, 0), np.float32), np.zeros(0, np.float32)
            nothing = Surface(np.zeros((7, 1), np.float32), (1, 1), coarse)
            return cls(levels, nothing, Samples(none, none, empty), none, (empty,) * LEVELS)
        cells, sigma = _cell_means(*depth, factor * BLOCK)
        points = _unproject_grid(cells, coarse)
        normals = _normals(points)
        edges, values = _edge_samples(levels, cells)
        return cls(levels, _surface(points, normals, sigma, coarse), _spread(points, normals, sigma), edges, values)


def _shrink(image: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return image
    return cv2.resize(image, (image.shape[1] // factor, image.shape[0] // factor), interpolation=cv2.INTER_AREA)


def _pyramid(gray: np.ndarray, intrinsics: np.ndarray) -> tuple[Gray, ...]:
    levels = []
    for level in range(LEVELS):
        image = _shrink(gray, 2**level)
        value = image - cv2.GaussianBlur(image, (0, 0), BACKGROUND)
        dx = cv2.Scharr(value, cv2.CV_32F, 1, 0, scale=1 / 32)
        dy = cv2.Scharr(value, cv2.CV_32F, 0, 1, scale=1 / 32)
        levels.append(Gray(cv2.merge([value, dx, dy]), pinhole.coarser(intrinsics, 2**level)))
    return tuple(levels)


def _cell_means(depth: np.ndarray, sigma: np.ndarray, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean inverse depth's depth of blocks and its sigma, metres, float32 [h, w]; NaN where half a block is unknown, or
    across a jump. Neighbouring pixels share their errors (smoothing, interpolation), so a block knows no more than one.
    """
    height, width = depth.shape[0] // factor * factor, depth.shape[1] // factor * factor
    depth = np.ascontiguousarray(depth[:height, :width], np.float32)
    known = np.isfinite(depth)
    inverse = _zero_where(~known, 1.0 / depth)
    size = (width // factor, height // factor)
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    mean, square = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (inverse, inverse * inverse))
    safe = np.maximum(share, 1e-6)
    mean, square = mean / safe, square / safe
    spread = np.sqrt(np.maximum(square - mean * mean, 0.0))
    good = (share >= 0.5) & (spread < 0.05 * mean)
    cells = np.where(good, 1.0 / np.maximum(mean, 1e-6), np.nan).astype(np.float32)
    noise = _zero_where(~known, np.array(sigma[:height, :width], np.float32))
    return cells, cells * cv2.resize(noise, size, interpolation=cv2.INTER_AREA) / safe


def _zero_where(unknown: np.ndarray, image: np.ndarray) -> np.ndarray:
    image[unknown] = 0.0
    return image


def _unproject_grid(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    return pinhole.grid_rays(depth.shape, intrinsics, np.float32) * depth[..., None]


def _normals(points: np.ndarray) -> np.ndarray:
    """Unit normals towards the camera from central differences, NaN at borders, holes and jumps of the depth."""
    normals = np.full_like(points, np.nan)
    if min(points.shape[:2]) < 3:
        return normals
    right = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = rigid.cross(down, right)
    z = points[1:-1, 1:-1, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = (np.abs(right[..., 2]) < 0.1 * z) & (np.abs(down[..., 2]) < 0.1 * z)
        normal = normal / np.linalg.norm(normal, axis=2, keepdims=True)
    normals[1:-1, 1:-1] = np.where(smooth[..., None], normal, np.nan)
    return normals


def _surface(points: np.ndarray, normals: np.ndarray, sigma: np.ndarray, intrinsics: np.ndarray) -> Surface:
    known = np.isfinite(normals[..., :1])
    cells = np.where(known, np.concatenate([points, normals, sigma[..., None]], 2), np.float32(0))
    return Surface(np.ascontiguousarray(cells.reshape(-1, 7).T), (sigma.shape[0], sigma.shape[1]), intrinsics)


def _spread(surface: np.ndarray, normals: np.ndarray, sigma: np.ndarray) -> Samples:
    """At most about `MOST_POINTS` cells, evenly spread."""
    known = np.nonzero(np.isfinite(normals[..., 0]).ravel())[0]
    # A fixed shuffle: a regular stride would take whole columns of the grid.
    order = np.random.default_rng(0).permutation(len(known))[:MOST_POINTS]
    chosen = np.sort(known[order])
    points, unit = (np.ascontiguousarray(grid.reshape(-1, 3)[chosen].T) for grid in (surface, normals))
    return Samples(points, unit, sigma.ravel()[chosen])


def _edge_samples(levels: tuple[Gray, ...], cells: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """The strongest gradient of each cell whose depth is known: points float32 [3, m], brightness of each level."""
    finest = levels[0]
    strength = cv2.magnitude(*(np.ascontiguousarray(finest.image[..., side]) for side in (1, 2)))
    height, width = (side // EDGE_CELL * EDGE_CELL for side in strength.shape)
    blocks = strength[:height, :width].reshape(height // EDGE_CELL, EDGE_CELL, width // EDGE_CELL, EDGE_CELL)
    flat = blocks.transpose(0, 2, 1, 3).reshape(height // EDGE_CELL, width // EDGE_CELL, -1)
    place = flat.argmax(2)
    row = np.arange(height // EDGE_CELL)[:, None] * EDGE_CELL + place // EDGE_CELL
    column = np.arange(width // EDGE_CELL)[None, :] * EDGE_CELL + place % EDGE_CELL
    row, column = row.ravel(), column.ravel()
    z = cells[np.minimum(row // BLOCK, cells.shape[0] - 1), np.minimum(column // BLOCK, cells.shape[1] - 1)]
    inner = (row > 2) & (column > 2) & (row < strength.shape[0] - 3) & (column < strength.shape[1] - 3)
    good = np.isfinite(z) & (strength[row, column] > FAINT) & inner
    row, column, z = row[good], column[good], z[good]
    pixels = np.column_stack([column, row]).astype(np.float64)
    points = pinhole.rays(pixels, finest.intrinsics) * z[:, None]
    values = []
    for number, level in enumerate(levels):
        x, y = ((pixels + 0.5) / 2**number - 0.5).astype(np.float32).T
        value = np.ascontiguousarray(level.image[..., 0])
        values.append(cv2.remap(value, x[None], y[None], cv2.INTER_LINEAR)[0] if len(x) else x)
    return np.ascontiguousarray(points.T, np.float32), tuple(values)
