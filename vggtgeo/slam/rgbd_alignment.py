"""Direct alignment of two RGB-D views: brightness and point-to-plane distance together, coarse to fine.

Steinbruecker, Sturm, Cremers 2011 (brightness), Chen and Medioni 1991 (planes), joined as by Kerl et al. 2013. With `T`
the motion source camera -> target camera, `x = T p` of a source point `p`:

    r_I = I_target(pi(x)) - a I_source     brightness without its local mean, `a` the ratio of the exposures
    r_D = n . (x - q)                      `q, n` the target's surface at the pixel that x falls on

Each iteration solves the 6 x 6 normal equations of both over the left tangent (`T <- exp(xi) T`, translation first),
weighted by Tukey's biweight. Cost: O(samples) an iteration, 1 ms for 5,000.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.geometry import rigid

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
FARTHEST = 0.15
"""Metres between a point and the surface it may belong to."""
LEAST_COSINE = 0.7
LEAST_SAMPLES = 60
MOST_POINTS = 2400
"""Surface points of the source that take part; more cost time and change nothing, for they share their errors."""
TUKEY = 4.685
"""Cut of the biweight in standard deviations, 95 % efficient under Gaussian noise."""


@dataclass(frozen=True, eq=False)
class _Gray:
    """One level: brightness without its local mean and its derivatives, float32 [h, w]; intrinsics of the level."""

    value: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    intrinsics: np.ndarray


@dataclass(frozen=True, eq=False)
class RgbdView:
    """What an alignment needs of one image.

    levels: finest first. surface: float32 [h, w, 3] points in the camera frame, metres, and normals: the same of unit
    normals towards the camera, NaN = none; surface_intrinsics of that grid. samples: points and normals float32 [n, 3]
    of cells spread over the image. edges: float64 [m, 3] points in the camera
    frame with a strong gradient, and edge_values: one float32 [m] of brightness for each level.
    """

    levels: tuple[_Gray, ...]
    surface: np.ndarray
    normals: np.ndarray
    surface_intrinsics: np.ndarray
    samples: tuple[np.ndarray, np.ndarray]
    edges: np.ndarray
    edge_values: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, image: np.ndarray, depth: np.ndarray | None, intrinsics: np.ndarray) -> RgbdView:
        """From an image uint8 [H, W, 3] and its depth float [H, W], metres, NaN = none."""
        factor = max(round(image.shape[1] / WIDTH), 1)
        gray = _shrink(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), factor)
        own = _scaled(intrinsics, factor)
        levels = _pyramid(gray, own)
        if depth is None or not np.isfinite(depth).any():
            nothing = np.full((1, 1, 3), np.nan, np.float32)
            none, empty = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
            return cls(levels, nothing, nothing, own, (none, none), none, (empty,) * LEVELS)
        cells = _cell_means(depth, factor * BLOCK)
        coarse = _scaled(intrinsics, factor * BLOCK)
        surface = _unproject_grid(cells, coarse)
        normals = _normals(surface)
        edges, values = _edge_samples(levels, cells)
        return cls(levels, surface, normals, coarse, _spread(surface, normals), edges, values)


@dataclass(frozen=True, eq=False)
class Aligned:
    """The result of an alignment.

    motion: float64 [4, 4], source camera -> target camera. information: float64 [6, 6] over its left tangent
    (translation first, 1/m^2 and 1/rad^2), neighbouring samples counted as one. edges, surface: share of the samples in
    view that agree with the motion, in [0, 1], NaN where there are too few. edge_count, surface_count: samples in view.
    correlation: of the brightness of all edge samples in view, NaN without any. overlap: share of the source's surface
    that falls on a known depth of the target.
    """

    motion: np.ndarray
    information: np.ndarray
    edges: float
    surface: float
    edge_count: int
    surface_count: int
    correlation: float
    overlap: float


@dataclass(frozen=True)
class RgbdAlignment:
    """iterations: of each level, finest first. brightness_noise: grey levels, least standard deviation of a brightness.
    edge_spread, surface_spread: how many neighbouring samples count as one independent.
    """

    iterations: tuple[int, ...] = (6, 8, 10)
    brightness_noise: float = 3.0
    edge_spread: float = 4.0
    surface_spread: float = 6.0

    def align(self, source: RgbdView, target: RgbdView, start: np.ndarray) -> Aligned | None:
        """The motion source -> target from `start` float64 [4, 4]; None where they share too little."""
        motion = start
        points, normals = source.samples
        rows = None
        for level in reversed(range(LEVELS)):
            step = 2 if level else 1
            for _ in range(self.iterations[level]):
                rows = self._rows(source, target, level, points[::step], normals[::step], motion)
                if rows is None:
                    return None
                change = _solve(*rows[:2])
                motion = _exponential(change) @ motion
                if np.abs(change).max() < (1e-5 if level == 0 else 1e-4):
                    break
        rows = self._rows(source, target, 0, points, normals, motion)
        if rows is None:
            return None
        information, _, evidence = rows
        return Aligned(motion, information, *evidence, overlap=evidence[3] / max(len(points), 1))

    def _rows(
        self,
        source: RgbdView,
        target: RgbdView,
        level: int,
        points: np.ndarray,
        normals: np.ndarray,
        motion: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, tuple[float, float, int, int, float]] | None:
        """Normal equations `H, g` of both terms at `motion`, and how far they agree."""
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        edges = _brightness(source, target, level, motion)
        surface = _planes(points, normals, target, motion)
        shares, counts = [float("nan")] * 2, [0, 0]
        correlation = float("nan")
        if edges is not None:
            jacobian, residual, correlation = edges
            sigma = max(1.4826 * float(np.median(np.abs(residual))), self.brightness_noise)
            weight = _biweight(residual / sigma) / (sigma**2 * self.edge_spread)
            hessian += (jacobian * weight[:, None]).T @ jacobian
            gradient += jacobian.T @ (weight * residual)
            shares[0], counts[0] = float(np.mean(np.abs(residual) < 3 * self.brightness_noise)), len(residual)
        if surface is not None:
            jacobian, residual = surface
            scale = max(1.4826 * float(np.median(np.abs(residual))), 1.0)
            weight = _biweight(residual / scale) / (scale**2 * self.surface_spread)
            hessian += (jacobian * weight[:, None]).T @ jacobian
            gradient += jacobian.T @ (weight * residual)
            shares[1], counts[1] = float(np.mean(np.abs(residual) < 3)), len(residual)
        if edges is None and surface is None:
            return None
        return hessian, gradient, (shares[0], shares[1], counts[0], counts[1], correlation)


def _brightness(
    source: RgbdView, target: RgbdView, level: int, motion: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Rows of `r_I`, float32 [m, 6], residuals [m] in grey levels, and the correlation of the brightness."""
    gray = target.levels[level]
    if len(source.edges) < LEAST_SAMPLES:
        return None
    x = source.edges @ motion[:3, :3].T + motion[:3, 3]
    fx, fy, cx, cy = gray.intrinsics
    height, width = gray.value.shape
    z = np.maximum(x[:, 2], 1e-3)
    u, v = fx * x[:, 0] / z + cx, fy * x[:, 1] / z + cy
    inside = (x[:, 2] > 0.1) & (u > 1) & (v > 1) & (u < width - 2) & (v < height - 2)
    if np.count_nonzero(inside) < LEAST_SAMPLES:
        return None
    x, u, v = x[inside], u[inside].astype(np.float32)[None], v[inside].astype(np.float32)[None]
    seen, dx, dy = (cv2.remap(image, u, v, cv2.INTER_LINEAR)[0] for image in (gray.value, gray.dx, gray.dy))
    reference = source.edge_values[level][inside]
    both = float(seen @ reference)
    correlation = both / float(np.linalg.norm(seen) * np.linalg.norm(reference) + 1e-9)
    exposure = float(np.clip(both / (reference @ reference + 1e-9), 0.6, 1.7))
    along_x, along_y = fx * dx / x[:, 2], fy * dy / x[:, 2]
    by_point = np.stack([along_x, along_y, -(along_x * x[:, 0] + along_y * x[:, 1]) / x[:, 2]], 1)
    jacobian = np.concatenate([by_point, np.cross(x, by_point)], 1)
    return jacobian, seen - exposure * reference, correlation


def _planes(
    points: np.ndarray, normals: np.ndarray, target: RgbdView, motion: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows of `r_D` [m, 6] and residuals [m], both in standard deviations of the sensor."""
    if len(points) < LEAST_SAMPLES or not len(target.surface):
        return None
    turn, shift = motion[:3, :3].astype(np.float32), motion[:3, 3].astype(np.float32)
    x = points @ turn.T + shift
    fx, fy, cx, cy = (np.float32(value) for value in target.surface_intrinsics)
    height, width = target.surface.shape[:2]
    z = np.maximum(x[:, 2], 1e-3)
    u, v = np.rint(fx * x[:, 0] / z + cx).astype(int), np.rint(fy * x[:, 1] / z + cy).astype(int)
    inside = (x[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    x, u, v = x[inside], u[inside], v[inside]
    q, n = target.surface[v, u], target.normals[v, u]
    turned = normals[inside] @ turn.T
    residual = ((x - q) * n).sum(1)
    with np.errstate(invalid="ignore"):
        one = (np.abs(residual) < FARTHEST) & ((n * turned).sum(1) > LEAST_COSINE)
    if np.count_nonzero(one) < LEAST_SAMPLES:
        return None
    x, n, residual, depth = x[one], n[one], residual[one], q[one, 2]
    # Nguyen, Izadi, Lovell 2012, as in `SensorDepth`, of both views; the relative part is what calibration leaves.
    sigma = np.sqrt(2) * np.hypot(0.0012 + 0.0019 * (depth - 0.4) ** 2, 0.003 * depth)
    return np.concatenate([n, np.cross(x, n)], 1) / sigma[:, None], residual / sigma


def _solve(hessian: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    damped = hessian + np.diag(1e-3 * np.diag(hessian) + 1e-9 * np.trace(hessian) + 1e-9)
    return -np.linalg.solve(damped, gradient)


def _biweight(residual: np.ndarray) -> np.ndarray:
    return np.maximum(1 - (residual / TUKEY) ** 2, 0.0) ** 2


def _exponential(tangent: np.ndarray) -> np.ndarray:
    """Exp on SO(3) x R^3: to first order the exponential of SE(3), and as good a retraction."""
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(tangent[3:])[0]
    motion[:3, 3] = tangent[:3]
    return motion


def _shrink(image: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return image
    return cv2.resize(image, (image.shape[1] // factor, image.shape[0] // factor), interpolation=cv2.INTER_AREA)


def _scaled(intrinsics: np.ndarray, factor: int) -> np.ndarray:
    """Of an image of blocks of `factor` pixels; integers are pixel centres."""
    return np.array([*intrinsics[:2], *(np.asarray(intrinsics[2:]) + 0.5 - factor / 2)]) / factor


def _pyramid(gray: np.ndarray, intrinsics: np.ndarray) -> tuple[_Gray, ...]:
    levels = []
    for level in range(LEVELS):
        image = _shrink(gray, 2**level)
        value = image - cv2.GaussianBlur(image, (0, 0), BACKGROUND)
        dx = cv2.Scharr(value, cv2.CV_32F, 1, 0, scale=1 / 32)
        dy = cv2.Scharr(value, cv2.CV_32F, 0, 1, scale=1 / 32)
        levels.append(_Gray(value, dx, dy, _scaled(intrinsics, 2**level)))
    return tuple(levels)


def _cell_means(depth: np.ndarray, factor: int) -> np.ndarray:
    """Mean inverse depth's depth of blocks, float32 [h, w]; NaN where half a block is unknown, or across a jump."""
    height, width = depth.shape[0] // factor * factor, depth.shape[1] // factor * factor
    known = np.isfinite(depth[:height, :width])
    inverse = np.where(known, 1.0 / np.where(known, depth[:height, :width], 1.0), 0.0).astype(np.float32)
    size = (width // factor, height // factor)
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    mean, square = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (inverse, inverse * inverse))
    safe = np.maximum(share, 1e-6)
    mean, square = mean / safe, square / safe
    spread = np.sqrt(np.maximum(square - mean * mean, 0.0))
    good = (share >= 0.5) & (spread < 0.05 * mean)
    return np.where(good, 1.0 / np.maximum(mean, 1e-6), np.nan).astype(np.float32)


def _unproject_grid(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float32)
    rays = np.stack([(u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1], np.ones_like(u)], -1)
    return (rays * depth[..., None]).astype(np.float32)


def _normals(points: np.ndarray) -> np.ndarray:
    """Unit normals towards the camera from central differences, NaN at borders, holes and jumps of the depth."""
    normals = np.full_like(points, np.nan)
    if min(points.shape[:2]) < 3:
        return normals
    right = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(down, right)
    z = points[1:-1, 1:-1, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = (np.abs(right[..., 2]) < 0.1 * z) & (np.abs(down[..., 2]) < 0.1 * z)
        normal = normal / np.linalg.norm(normal, axis=2, keepdims=True)
    normals[1:-1, 1:-1] = np.where(smooth[..., None], normal, np.nan)
    return normals


def _spread(surface: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of at most about `MOST_POINTS` cells, evenly spread."""
    known = np.nonzero(np.isfinite(normals[..., 0]).ravel())[0]
    # A fixed shuffle: a regular stride would take whole columns of the grid.
    order = np.random.default_rng(0).permutation(len(known))[:MOST_POINTS]
    chosen = np.sort(known[order])
    return surface.reshape(-1, 3)[chosen], normals.reshape(-1, 3)[chosen]


def _edge_samples(levels: tuple[_Gray, ...], cells: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """The strongest gradient of each cell whose depth is known: points float64 [m, 3], brightness of each level."""
    finest = levels[0]
    strength = np.hypot(finest.dx, finest.dy)
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
    points = rigid.rays(pixels, finest.intrinsics) * z[:, None]
    values = []
    for number, level in enumerate(levels):
        x, y = ((pixels + 0.5) / 2**number - 0.5).astype(np.float32).T
        values.append(cv2.remap(level.value, x[None], y[None], cv2.INTER_LINEAR)[0] if len(x) else x)
    return points, tuple(values)
