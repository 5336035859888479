"""Alignment of dense depth between keyframes: point-to-plane as a quadratic on relative poses.

So surfaces without texture constrain the adjustment (Chen & Medioni 1991; Newcombe et al., KinectFusion, 2011).

At the current poses every pair (i, j) gives residuals `n . (T_ji p - q)` in standard deviations of both depths, where
`q, n` is the surface of j at the pixel to which `p` of i projects. Their normal equations `H, g` over the left tangent
`eta` of `T_ji` enter the adjustment as a term on the pair. Relinearising after each adjustment makes it Gauss-Newton on
the sum of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vggtgeo.bundle.terms.measured_pose import SurfaceAlignment
from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.robust import TUKEY
from vggtgeo.slam.perception.rgbd_view import surface_normals
from vggtgeo.slam.sparse_map.factors import surface_term
from vggtgeo.slam.sparse_map.keyframe import Keyframe

CELL = 4
"""Pixels a side of the blocks whose median depth makes one surface point."""
MAX_DISTANCE = 0.10
"""Largest distance of points on one surface, metres: 2.5 standard deviations of a depth camera at 5 m (4 cm, Khoshelham
and Elberink 2012)."""
MIN_COSINE = 0.8
"""Smallest cosine between the normals of points on one surface, 37 degrees: those of cells have a noise of some, and
most edges of a room turn by 90."""
MIN_POINTS = 150
"""Minimum number of the source's samples near a surface of the target: half as many as a pair counts for
(`DepthSettings.surface_points`)."""


@dataclass(frozen=True, eq=False)
class SurfaceRows:
    """Cells as rows: points and unit normals float32 [3, m], camera frame, standard deviations of the depth [m]."""

    points: np.ndarray
    normals: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True, eq=False)
class Surface:
    """A keyframe's depth as points float32 [h, w, 3] and unit normals [h, w, 3], camera frame, NaN = unknown.

    sigma: standard deviation of the depth, metres, [h, w].
    """

    points: np.ndarray
    normals: np.ndarray
    sigma: np.ndarray
    intrinsics: np.ndarray

    @classmethod
    def of(cls, keyframe: Keyframe, intrinsics: np.ndarray) -> Surface:
        """Compute block medians of the depth, and normals by central differences that do not cross a depth edge."""
        middle = _block_medians(keyframe.depth)
        coarse = pinhole.coarser(intrinsics, CELL)
        points = pinhole.grid_rays(middle.shape, coarse) * middle[..., None]
        sigma = _block_medians(keyframe.depth_sigma) * middle
        # Those of all keyframes are in memory together: half a megabyte each in single precision.
        return cls(
            points.astype(np.float32), surface_normals(points).astype(np.float32), sigma.astype(np.float32), coarse
        )

    @cached_property
    def rows(self) -> SurfaceRows:
        """All cells, row by row of the image."""
        points, normals = (np.ascontiguousarray(grid.reshape(-1, 3).T) for grid in (self.points, self.normals))
        return SurfaceRows(points, normals, self.sigma.ravel())

    @cached_property
    def samples(self) -> SurfaceRows:
        """Every other cell with a normal, as on a chessboard: neighbours share their errors."""
        rows, columns = np.indices(self.sigma.shape)
        good = np.flatnonzero(np.isfinite(self.rows.normals[0]) & ((rows + columns) % 2 == 0).ravel())
        return SurfaceRows(self.rows.points[:, good], self.rows.normals[:, good], self.rows.sigma[good])


class Alignment(NamedTuple):
    """Normal equations of one pair over the left tangent of `T_ji`, in units of the sensor's standard deviation."""

    hessian: np.ndarray
    gradient: np.ndarray
    points: int


def align(
    first: int, second: int, surfaces: Sequence[Surface], relative: np.ndarray, effective: float
) -> Alignment | None:
    """Linearise surface i = `first` against j = `second`; None if the overlap is too small.

    effective: largest number of independent points, since neighbouring depths share their errors.
    """
    source, target = surfaces[first].samples, surfaces[second]
    turn = relative[:3, :3]
    points = turn @ source.points + relative[:3, 3:]
    inside, rows, columns = pinhole.visible(points.T, target.intrinsics, target.sigma.shape)
    seen, cell = np.flatnonzero(inside), rows * target.sigma.shape[1] + columns
    away, n = points.take(seen, 1) - target.rows.points.take(cell, 1), target.rows.normals.take(cell, 1)
    facing = (n * (turn @ source.normals.take(seen, 1))).sum(0)
    # A comparison with NaN, where the target has no surface, is false.
    with np.errstate(invalid="ignore"):
        one = np.flatnonzero(((away * away).sum(0) < MAX_DISTANCE**2) & (facing > MIN_COSINE))
    if len(one) < MIN_POINTS:
        return None
    seen, cell, away, n = seen.take(one), cell.take(one), away.take(one, 1), n.take(one, 1)
    sigma = np.hypot(source.sigma.take(seen), target.rows.sigma.take(cell))
    residual = (n * away).sum(0)
    # Tukey's biweight, wide enough for a pose that is off by a few standard deviations.
    scale = max(float(np.median(np.abs(residual / sigma))) * TUKEY, 3.0)
    weight = np.maximum(1 - (residual / sigma / scale) ** 2, 0.0) ** 2 / sigma**2
    # Neighbouring depths share their errors, so the information of a surface does not grow with its number of pixels.
    weight *= min(effective / len(one), 1.0)
    (x, y, z), (a, b, c) = points.take(seen, 1), n
    # Row of `n . (T p - q)` over the left tangent: `[n, p x n]`.
    jacobian = np.stack([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a])
    weighted = jacobian * weight
    return Alignment(weighted @ jacobian.T, weighted @ residual, len(one))


def align_pairs(
    keyframes: Sequence[Keyframe],
    pairs: Sequence[tuple[int, int]],
    surfaces: Sequence[Surface],
    effective: float,
    room: int,
) -> SurfaceAlignment:
    """Return the alignments of all pairs at the current poses as one term; pairs without overlap have weight 0.

    room: observations of the term.
    """
    relative = np.tile(np.eye(4), (room, 1, 1))
    for row, (i, j) in enumerate(pairs):
        relative[row] = keyframes[j].pose @ rigid.invert(keyframes[i].pose)
    hessians, gradients = np.zeros((room, 6, 6)), np.zeros((room, 6))
    # One after the other: a pair is half a millisecond of short calls, and two threads wait longer for Python's lock.
    for row, pair in enumerate(pairs):
        alignment = align(*pair, surfaces, relative[row], effective)
        if alignment is not None:
            hessians[row], gradients[row], _ = alignment
    return surface_term([*pairs, *[(0, 0)] * (room - len(pairs))], relative, hessians, gradients)


def _block_medians(values: np.ndarray) -> np.ndarray:
    """Return medians of blocks of `CELL` x `CELL`, float32 [h, w]; NaN if fewer than half of a block is known."""
    height, width = values.shape[0] // CELL, values.shape[1] // CELL
    blocks = values[: height * CELL, : width * CELL].astype(np.float32).reshape(height, CELL, width, CELL)
    ordered = np.sort(blocks.transpose(0, 2, 1, 3).reshape(height, width, -1), axis=2)
    count = np.isfinite(ordered).sum(2)
    middle = np.take_along_axis(ordered, (count // 2)[..., None].clip(0, CELL**2 - 1), 2)[..., 0]
    return np.where(count >= CELL**2 // 2, middle, np.nan)
