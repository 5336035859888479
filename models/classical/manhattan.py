"""Orientation of a view in a Manhattan world (three perpendicular directions), from its line segments.

The plane through the camera's centre and a segment has the normal n; a segment along the axis d satisfies n . d = 0.
With the axes d_1, d_2, d_3 of a frame as columns of the rotation C (frame -> camera), C <- exp(w) C changes the
residual of a segment on axis k by (d_k x n) . w: three unknowns, one row a segment, a robust Gauss-Newton. Source:
J. Coughlan, A. Yuille, "Manhattan World", ICCV 1999; the start without a prediction is by pairs of segments (J.-C.
Bazin, M. Pollefeys, "3-line RANSAC for orthogonal vanishing point detection", IROS 2012), over the longest of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import cv2
import numpy as np
from vggtgeo.models.classical.pixel_matcher import unit

from vggtgeo.geometry import pinhole


@dataclass(frozen=True, eq=False)
class ManhattanView:
    """rotation: float64 [3, 3], C, frame -> camera. information: float64 [3, 3], rad^-2, of w in C = exp(w) C_true.

    share: of the length of all segments, along an axis. axes: int [3], number of segments on each.
    """

    rotation: np.ndarray
    information: np.ndarray
    share: float
    axes: np.ndarray


@dataclass(frozen=True)
class ManhattanEstimator:
    """Estimates the Manhattan frame of a view.

    end_error: standard deviation of a segment's end across it, pixels. gate: maximum angle between a segment and its
    axis, seen from the segment's middle, radians. min_share: minimum share of the segments' length along an axis.
    min_segments: minimum number on two axes each. clear: minimum deviation of a segment from all other axes,
    standard deviations. floor: minimum standard deviation of the result, radians (walls are not exactly straight).
    """

    end_error: float = 0.7
    gate: float = float(np.deg2rad(3.0))
    min_share: float = 0.85
    min_segments: int = 4
    clear: float = 3.0
    floor: float = float(np.deg2rad(0.1))

    def estimate(
        self, endpoints: np.ndarray, intrinsics: np.ndarray, predicted: np.ndarray | None = None
    ) -> ManhattanView | None:
        """Return the frame's orientation in a view; None if the segments do not determine three perpendicular
        directions.

        endpoints: float [L, 2, 2], pixels. intrinsics: float [4]. predicted: float [3, 3], frame -> camera; without it
        order and signs of the axes are arbitrary.
        """
        if len(endpoints) < 2 * self.min_segments:
            return None
        planes = _Planes.of(endpoints, np.asarray(intrinsics, float))
        start = _search(planes, np.sin(self.gate)) if predicted is None else predicted
        rotation = np.array(start, float)
        # Not `gauss_newton`: segments change their axis between steps, so that the energy need not decrease.
        for _ in range(10):
            fit = self._fit(rotation, planes)
            weight = fit.near / (fit.sigma**2 + fit.off**2)  # Cauchy, one deviation wide
            normal = (fit.rows * weight[:, None]).T @ fit.rows
            if np.linalg.matrix_rank(normal) < 3:
                return None
            step = np.linalg.solve(normal, -(fit.rows * weight[:, None]).T @ fit.off)
            rotation = cv2.Rodrigues(step)[0] @ rotation
            if np.linalg.norm(step) < 1e-7:
                break
        return self._judged(rotation, self._fit(rotation, planes), planes)

    def _fit(self, rotation: np.ndarray, planes: _Planes) -> _Fit:
        products = planes.normals @ rotation
        # An error of a segment's direction rotates its plane about the ray to its middle, an error of its position
        # about the direction across that ray.
        lever = np.abs(np.cross(planes.middles, planes.normals) @ rotation)
        turned = np.sqrt(2) * self.end_error / planes.lengths[:, None] * lever
        moved = self.end_error / (np.sqrt(2) * planes.focal) * np.abs(planes.middles @ rotation)
        sigmas = np.hypot(turned, moved)
        deviations = np.abs(products) / sigmas
        axis = np.argmin(deviations, axis=1)
        # A segment that fits another axis as well (on the horizon, for example) would bias the result.
        clear = np.sort(deviations, axis=1)[:, 1] > self.clear
        own = np.arange(len(axis))
        off, sigma = products[own, axis], sigmas[own, axis]
        near = np.abs(off) < self.gate * lever[own, axis] + 2 * sigma
        return _Fit(axis, np.cross(rotation.T[axis], planes.normals), off, sigma, near & clear)

    def _judged(self, rotation: np.ndarray, fit: _Fit, planes: _Planes) -> ManhattanView | None:
        good = fit.near & (np.abs(fit.off) < 3 * fit.sigma)
        share = float(planes.lengths[good].sum() / planes.lengths.sum())
        axes = np.bincount(fit.axis[good], minlength=3)
        if share < self.min_share or np.sort(axes)[1] < self.min_segments:
            return None
        information = (fit.rows[good] / fit.sigma[good, None] ** 2).T @ fit.rows[good]
        covariance = np.linalg.inv(information) + self.floor**2 * np.eye(3)
        return ManhattanView(rotation, np.linalg.inv(covariance), share, axes)


@dataclass(frozen=True, eq=False)
class _Planes:
    """Segments: unit normals of their planes and unit rays to their middles [L, 3], lengths in pixels [L]."""

    normals: np.ndarray
    middles: np.ndarray
    lengths: np.ndarray
    focal: float

    @classmethod
    def of(cls, endpoints: np.ndarray, intrinsics: np.ndarray) -> _Planes:
        rays = pinhole.rays(endpoints, intrinsics)
        lengths = np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=1)
        normals, middles = unit(np.cross(rays[:, 0], rays[:, 1]), 1e-12), unit(rays.mean(axis=1), 1e-12)
        return cls(normals, middles, lengths, float(intrinsics[0]))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Segments: axis, residual with derivative and standard deviation, and whether it is an inlier."""

    axis: np.ndarray
    rows: np.ndarray
    off: np.ndarray
    sigma: np.ndarray
    near: np.ndarray


def nearest_frame(rotation: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return `rotation` [3, 3] with columns permuted and signs changed (24 ways) to be nearest to `reference`."""
    return max((rotation @ symmetry for symmetry in _SYMMETRIES), key=lambda turned: float(np.sum(turned * reference)))


_SYMMETRIES = [
    matrix
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3))
    if np.linalg.det(matrix := np.eye(3)[:, list(order)] * np.array(signs)) > 0
]


def _search(planes: _Planes, near: float) -> np.ndarray:
    """Return the rotation whose axes explain most length, among candidates from pairs of the 24 longest segments.

    One axis of a candidate is one of the 12 directions that most length supports.
    """
    normals, lengths = planes.normals, planes.lengths
    top = np.argsort(-lengths)[:24]
    first, second = np.triu_indices(len(top), k=1)
    crossing = np.cross(normals[top[first]], normals[top[second]])
    size = np.linalg.norm(crossing, axis=1)
    directions = crossing[size > 0.05] / size[size > 0.05, None]
    support = lengths @ (np.abs(normals @ directions.T) < near)
    best, most = np.eye(3), -1.0
    for direction in directions[np.argsort(-support)[:12]]:
        across = np.cross(direction, normals[top])
        size = np.linalg.norm(across, axis=1)
        for other in across[size > 0.2] / size[size > 0.2, None]:
            rotation = np.column_stack([direction, other, np.cross(direction, other)])
            explained = float(lengths @ (np.abs(normals @ rotation).min(axis=1) < near))
            if explained > most:
                best, most = rotation, explained
    return best
