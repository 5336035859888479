"""Pictures of a scene: visible surfaces, clean edges, glass, exact depth.

Each pixel is shaded once at its centre; pixels whose four sub-pixels do not all see the same surface are shaded four
times and averaged, so that edges are as clean as in 2 x 2 supersampling at a fraction of its cost. Depth is that of
the pixel's centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.simulation.raster import EMPTY, View, inverse_depth_at, rasterise, shade, view_from
from vggtgeo.simulation.scene import Scene
from vggtgeo.simulation.shapes import Surfaces

_GLASS_TINT = np.array([0.86, 0.90, 0.88], np.float32)


@dataclass(frozen=True, eq=False)
class Picture:
    """light: float32 [H, W, 3], linear. depth: float64 [H, W], metres, NaN = nothing. surface: int32 [H, W].

    glass: bool [H, W], pixels seen through a pane; their depth is that of what is behind it.
    """

    light: np.ndarray
    depth: np.ndarray
    surface: np.ndarray
    glass: np.ndarray


@dataclass(frozen=True, eq=False)
class _Grid:
    """Rays of all pixels (or sub-pixels): normalised x [W] and y [H], float64; focal in pixels."""

    xs: np.ndarray
    ys: np.ndarray
    focal: float

    @classmethod
    def of(cls, intrinsics: tuple[float, float, float, float], size: tuple[int, int], factor: int) -> _Grid:
        fx, fy, cx, cy = intrinsics
        columns = (np.arange(factor * size[0]) + 0.5) / factor - 0.5
        rows = (np.arange(factor * size[1]) + 0.5) / factor - 0.5
        return cls((columns - cx) / fx, (rows - cy) / fy, fx)

    def rays(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.xs[columns].astype(np.float32), self.ys[rows].astype(np.float32)


def render(
    scene: Scene, pose: np.ndarray, intrinsics: tuple[float, float, float, float], size: tuple[int, int]
) -> Picture:
    """Render the scene from `pose` (world -> camera [4, 4]) with `intrinsics` (pixels) and `size` (W, H)."""
    grid = _Grid.of(intrinsics, size, 1)
    view = view_from(scene.surfaces, pose)
    nearest, which = rasterise(view, grid.xs, grid.ys)
    rows, columns = np.indices(which.shape).reshape(2, -1)
    light = shade(scene, view, which.ravel(), *grid.rays(rows, columns), nearest.ravel(), grid.focal)
    light = light.reshape(*which.shape, 3)
    _soften_edges(scene, view, light, which, _Grid.of(intrinsics, size, 2))
    glass = _add_glass(scene, pose, light, nearest, grid)
    return Picture(light, _exact_depth(view, which, grid), which, glass)


def _exact_depth(view: View, which: np.ndarray, grid: _Grid) -> np.ndarray:
    depth = np.full(which.shape, np.nan)
    rows, columns = np.nonzero(which != EMPTY)
    depth[rows, columns] = 1.0 / inverse_depth_at(view, which[rows, columns], grid.xs[columns], grid.ys[rows])
    return depth


def _soften_edges(scene: Scene, view: View, light: np.ndarray, which: np.ndarray, fine_grid: _Grid) -> None:
    """Replace pixels of `light` that lie on an edge by the mean of their sub-pixels."""
    nearest, fine = rasterise(view, fine_grid.xs, fine_grid.ys)
    quarters = [(i, j) for i in (0, 1) for j in (0, 1)]
    mixed = np.zeros(which.shape, bool)
    for i, j in quarters:
        mixed |= fine[i::2, j::2] != which
    rows, columns = np.nonzero(mixed)
    total = np.zeros((len(rows), 3), np.float32)
    for i, j in quarters:
        at = (2 * rows + i, 2 * columns + j)
        total += shade(scene, view, fine[at], *fine_grid.rays(*at), nearest[at], fine_grid.focal)
    light[rows, columns] = 0.25 * total


def _add_glass(scene: Scene, pose: np.ndarray, light: np.ndarray, nearest: np.ndarray, grid: _Grid) -> np.ndarray:
    """Add the mirror image of every visible pane to `light`; returns the pixels behind glass, bool [H, W]."""
    view = view_from(scene.panes, pose, two_sided=True)
    front, pane = rasterise(view, grid.xs, grid.ys)
    glass = (pane != EMPTY) & (front > nearest)
    for index in np.unique(pane[glass]):
        part = glass & (pane == index)
        rows, columns = np.nonzero(part)
        y0, y1, x0, x1 = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
        mirrored = view_from(scene.surfaces, pose @ _reflection(scene.panes, int(index)))
        limit = np.where(part, front, np.float32(0))[y0:y1, x0:x1]
        w, which = rasterise(mirrored, grid.xs[x0:x1], grid.ys[y0:y1], limit)
        inside = (rows - y0, columns - x0)
        x, y = grid.rays(rows, columns)
        mirror = shade(scene, mirrored, which[inside], x, y, w[inside], grid.focal)
        share = _fresnel(view, int(index), x, y)[:, None]
        light[rows, columns] = (1 - share) * _GLASS_TINT * light[rows, columns] + share * mirror
    return glass


def _reflection(panes: Surfaces, index: int) -> np.ndarray:
    """Mirror at a pane's plane, [4, 4]."""
    normal = panes.normal[index]
    matrix = np.eye(4)
    matrix[:3, :3] -= 2 * np.outer(normal, normal)
    matrix[:3, 3] = 2 * normal * (normal @ panes.origin[index])
    return matrix


def _fresnel(view: View, index: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the reflected share of a sheet of glass (both faces; Schlick's approximation)."""
    normal = view.normal[index].astype(np.float32)
    cosine = np.abs(normal[0] * x + normal[1] * y + normal[2]) / np.sqrt(x * x + y * y + 1.0)
    return 0.08 + 0.92 * (1.0 - cosine) ** 5
