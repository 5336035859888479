"""Direct alignment of two RGB-D views: brightness and point-to-plane distance together, coarse to fine.

Steinbruecker, Sturm, Cremers 2011 (brightness), Chen and Medioni 1991 (planes), joined as by Kerl et al. 2013. With `T`
the motion source camera -> target camera, `x = T p` of a source point `p`:

    r_I = I_target(pi(x)) - a I_source     brightness without its local mean, `a` the ratio of the exposures
    r_D = n . (x - q)                      `q, n` the target's surface at the pixel that x falls on

Each iteration solves the 6 x 6 normal equations of both over the left tangent (`T <- exp(xi) T`, translation first),
weighted by Tukey's biweight. Cost: O(samples) an iteration, 0.6 ms for 6,000: coordinates stand in rows [3, n], in
single precision, whose rounding moves a pose by micrometres.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.models.rigid_motion import exponential
from vggtgeo.slam.rgbd_view import LEVELS, RgbdView, Samples

FARTHEST = 0.15
"""Metres between a point and the surface it may belong to."""
LEAST_COSINE = 0.7
LEAST_SAMPLES = 60
NAN = float("nan")
SETTLED = 1e-4
"""Metres and radians: a smaller step ends the finest level, ten times it a coarser one. A pose is known to a millimetre
at best; with a tenth of this, poses of redkitchen and corridor-office differ by 0.1 mm, for twice the iterations."""
TUKEY = 4.685
"""Cut of the biweight in standard deviations, 95 % efficient under Gaussian noise."""


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
        for level in reversed(range(LEVELS)):
            samples = source.samples.every(2 if level else 1)
            for _ in range(self.iterations[level]):
                edges, surface = _brightness(source, target, level, motion), _planes(samples, target, motion)
                if edges is None and surface is None:
                    return None
                change = _solve(*self._normal_equations(edges, surface))
                motion = exponential(change) @ motion
                if np.abs(change).max() < (SETTLED if level == 0 else 10 * SETTLED):
                    break
        return self._judged(source, target, motion)

    def _judged(self, source: RgbdView, target: RgbdView, motion: np.ndarray) -> Aligned | None:
        """The result, with how far both terms agree with it."""
        edges, surface = _brightness(source, target, 0, motion), _planes(source.samples, target, motion)
        if edges is None and surface is None:
            return None
        seen = 0 if surface is None else len(surface.residual)
        return Aligned(
            motion,
            self._normal_equations(edges, surface)[0],
            edges=NAN if edges is None else edges.share_within(3 * self.brightness_noise),
            surface=NAN if surface is None else surface.share_within(3),
            edge_count=0 if edges is None else len(edges.residual),
            surface_count=seen,
            correlation=NAN if edges is None else edges.correlation,
            overlap=seen / max(len(source.samples.sigma), 1),
        )

    def _normal_equations(self, edges: _Rows | None, surface: _Rows | None) -> tuple[np.ndarray, np.ndarray]:
        """`H, g` float64 [6, 6], [6] of the terms that there are."""
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        for rows, noise, spread in (
            (edges, self.brightness_noise, self.edge_spread),
            (surface, 1, self.surface_spread),
        ):
            if rows is not None:
                scale = max(1.4826 * _median(np.abs(rows.residual)), noise)
                weighted = rows.jacobian * (_biweight(rows.residual, scale) / (scale**2 * spread))
                hessian += weighted @ rows.jacobian.T
                gradient += weighted @ rows.residual
        return hessian, gradient


@dataclass(frozen=True, eq=False)
class _Rows:
    """One term at a motion: jacobian float32 [6, m] over its left tangent, residual [m]. correlation: of brightness."""

    jacobian: np.ndarray
    residual: np.ndarray
    correlation: float = NAN

    @classmethod
    def of(cls, points: np.ndarray, by_point: np.ndarray, residual: np.ndarray, correlation: float = NAN) -> _Rows:
        """From the derivative by the point that moves, both [3, m]: the tangent's rotation turns it, `x cross row`."""
        (x, y, z), (a, b, c) = points, by_point
        return cls(np.stack([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a]), residual, correlation)

    def share_within(self, gate: float) -> float:
        return float(np.mean(np.abs(self.residual) < gate))


def _brightness(source: RgbdView, target: RgbdView, level: int, motion: np.ndarray) -> _Rows | None:
    """`r_I` in grey levels; None of too few samples in view."""
    gray = target.levels[level]
    if source.edges.shape[1] < LEAST_SAMPLES:
        return None
    x = _moved(source.edges, motion)
    u, v = _projected(x, gray.intrinsics)
    height, width = gray.image.shape[:2]
    inside = np.flatnonzero((u > 1) & (v > 1) & (u < width - 2) & (v < height - 2))
    if len(inside) < LEAST_SAMPLES:
        return None
    x = x.take(inside, 1)
    seen, dx, dy = cv2.remap(gray.image, u.take(inside), v.take(inside), cv2.INTER_LINEAR).reshape(-1, 3).T
    reference = source.edge_values[level].take(inside)
    both = float(seen @ reference)
    correlation = both / float(np.linalg.norm(seen) * np.linalg.norm(reference) + 1e-9)
    exposure = np.float32(np.clip(both / float(reference @ reference + 1e-9), 0.6, 1.7))
    fx, fy = gray.intrinsics[:2].astype(np.float32)
    along_x, along_y = fx * dx / x[2], fy * dy / x[2]
    by_point = np.stack([along_x, along_y, -(along_x * x[0] + along_y * x[1]) / x[2]])
    return _Rows.of(x, by_point, seen - exposure * reference, correlation)


def _planes(samples: Samples, target: RgbdView, motion: np.ndarray) -> _Rows | None:
    """`r_D` and its rows, both in standard deviations of the two depths; None of too few samples in view.

    Along the normal the error is at most that of the depth: a standard deviation on the safe side.
    """
    if len(samples.sigma) < LEAST_SAMPLES:
        return None
    height, width = target.surface.shape
    x = _moved(samples.points, motion)
    u, v = np.rint(_projected(x, target.surface.intrinsics))
    inside = np.flatnonzero((u >= 0) & (v >= 0) & (u < width) & (v < height))
    x = x.take(inside, 1)
    cells = target.surface.cells.take((v.take(inside) * width + u.take(inside)).astype(np.intp), 1)
    q, n = cells[:3], cells[3:6]
    turned = motion[:3, :3].astype(np.float32) @ samples.normals.take(inside, 1)
    residual = ((x - q) * n).sum(0)
    # A cell without a surface has no normal: the cosine of zero is below any level.
    one = np.flatnonzero((np.abs(residual) < FARTHEST) & ((n * turned).sum(0) > LEAST_COSINE))
    if len(one) < LEAST_SAMPLES:
        return None
    sigma = np.hypot(samples.sigma.take(inside.take(one)), cells[6].take(one))
    return _Rows.of(x.take(one, 1), n.take(one, 1) / sigma, residual.take(one) / sigma)


def _moved(points: np.ndarray, motion: np.ndarray) -> np.ndarray:
    near = motion.astype(np.float32)
    return near[:3, :3] @ points + near[:3, 3:]


def _projected(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels float32 [2, n]; NaN, which is in no image, of points nearer than 10 cm, where sensors of depth begin."""
    z = np.where(points[2] > 0.1, points[2], np.float32(np.nan))
    focal, centre = intrinsics.astype(np.float32).reshape(2, 2, 1)
    return points[:2] / z * focal + centre


def _median(values: np.ndarray) -> float:
    """The middle value, the upper one of an even number."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def _solve(hessian: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    damped = hessian + np.diag(1e-3 * np.diag(hessian) + 1e-9 * np.trace(hessian) + 1e-9)
    return -np.linalg.solve(damped, gradient)


def _biweight(residual: np.ndarray, scale: float) -> np.ndarray:
    share = residual * np.float32(1 / (TUKEY * scale))
    inner = np.maximum(1 - share * share, 0)
    return inner * inner
