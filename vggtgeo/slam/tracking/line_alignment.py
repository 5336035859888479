"""Pose from line segments: 3D segments of a keyframe against the segments detected in a frame.

With `T` the motion keyframe camera -> frame camera, `X` an end of a segment in the keyframe's camera, and `l = (a, b,
c)`, `a^2 + b^2 = 1`, the line of the matched segment:

    r = l . (pi(T X), 1)      pixels, one for each end

Its variance has three parts: the observed line at the position `u` of the projected end (0 and 1 at the observed ends,
each with standard deviation `s` across the segment), the end in the keyframe, and its inverse depth `d`, which moves
the projection along the epipolar line:

    sigma^2 = s^2 ((1 - u)^2 + u^2) + s^2 + ((a, b) . d pi / d d)^2 sigma_d^2

So an end far beyond the observed segment has a large variance, and motion along the segment is not constrained. Each
iteration solves the 6 x 6 normal equations over the left tangent (`T <- exp(xi) T`, translation first), together with
the prior information of `T`, weighted by Tukey's biweight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.gauss_newton import damped_step
from vggtgeo.geometry.rigid import exponential
from vggtgeo.geometry.robust import ROUNDING, TUKEY, sigma_by_median
from vggtgeo.models.classical import ManhattanEstimator, line_coefficients
from vggtgeo.models.roles import LineFeatures, LineMatcher, RelativeView
from vggtgeo.slam.perception.rgbd_alignment import CONVERGED, MIN_DEPTH
from vggtgeo.slam.sparse_map.keyframe import MIN_INVERSE_DEPTH, Keyframe
from vggtgeo.slam.tracking.pose_acceptance import SYSTEMATIC, tangent, worst_sigma

END_SIGMA = ManhattanEstimator.end_error
"""Standard deviation of a segment's end across it, pixels."""
MIN_LINES = 3
"""Three lines in general position determine a pose."""
ITERATIONS, ROUNDS = 8, 3
"""Steps after each matching, and matchings: each starts from the better pose."""
MAX_MISS = 80.0
"""Largest search radius of matching, pixels: beyond it wrong segments are as near as the right one."""


@dataclass(frozen=True, eq=False)
class SpaceSegments:
    """Segments of a keyframe whose depth is known.

    index: int [l], in the keyframe's own list. rays: float64 [l, 2, 3] of their ends, z = 1. inverse_depth, sigma:
    float64 [l, 2], of their ends and its standard deviation, 1/m.
    """

    index: np.ndarray
    rays: np.ndarray
    inverse_depth: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(cls, keyframe: Keyframe, intrinsics: np.ndarray) -> SpaceSegments:
        """Return the segments with ends from the current inverse depths of their samples: affine along a segment."""
        count, samples, segment = len(keyframe.lines), keyframe.samples, keyframe.sample_segment
        known = np.isfinite(samples.inverse_depth) & np.isfinite(samples.prior_sigma)
        ends = keyframe.lines.segments.endpoints.reshape(count, 2, 2)
        start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
        fraction = ((samples.pixels - start[segment]) * along[segment]).sum(1) / (along**2).sum(1)[segment]
        total = lambda values: np.bincount(segment[known], values[known], count)
        # Sums of the normal equations of all lines at once.
        n, t, tt = total(np.ones_like(fraction)), total(fraction), total(fraction**2)
        d, td, s = total(samples.inverse_depth), total(fraction * samples.inverse_depth), total(samples.prior_sigma)
        spread = n * tt - t * t
        index = np.nonzero(n >= 2)[0]  # samples are pixels apart
        n, t, tt, d, td, spread = (values[index] for values in (n, t, tt, d, td, spread))
        # Least-squares line through the samples: inverse depth is affine in the pixel along the image of a straight
        # line.
        offset, slope = (tt * d - t * td) / spread, (n * td - t * d) / spread
        inverse = np.stack([offset, offset + slope], 1)
        # An end behind the camera, or at infinity, comes from extrapolation.
        good = (inverse > MIN_INVERSE_DEPTH).all(1)
        index = index[good]
        rays = pinhole.rays(keyframe.lines.segments.endpoints[index], intrinsics)
        sigma = np.repeat((s[index] / n[good])[:, None], 2, 1)
        return cls(index, rays, inverse[good], sigma)


@dataclass(frozen=True, eq=False)
class AlignedLines:
    """The result of an alignment.

    motion: float64 [4, 4], keyframe camera -> frame camera. information: float64 [6, 6] of the lines alone over its
    left tangent. agreed: matched segments with both ends within three standard deviations of their lines. visible:
    segments of the keyframe that are expected in the image at that pose.
    """

    motion: np.ndarray
    information: np.ndarray
    agreed: int
    visible: int


def align_lines(
    source: Keyframe,
    seen: LineFeatures,
    matcher: LineMatcher,
    start: np.ndarray,
    known: np.ndarray,
    intrinsics: np.ndarray,
) -> AlignedLines | None:
    """Return the motion keyframe -> frame by their segments, from `start` float64 [4, 4] with information `known` [6,
    6].

    None if fewer than three segments are matched, or all are behind the camera in the end.
    """
    segments = SpaceSegments.of(source, intrinsics)
    if len(segments.index) < MIN_LINES or len(seen) < MIN_LINES:
        return None
    depths = np.full((len(source.lines), 2), np.nan)
    depths[segments.index] = 1.0 / segments.inverse_depth
    place = np.full(len(source.lines), -1)
    place[segments.index] = np.arange(len(segments.index))
    motion, rows = start, None
    believed = known
    for _ in range(ROUNDS):
        error = _miss(believed, segments, intrinsics)
        found = matcher.match(source.lines, seen, RelativeView(motion, intrinsics, depths, error))
        has_depth = place[found.index_i] >= 0
        if np.count_nonzero(has_depth) < MIN_LINES:
            return None
        own, theirs = place[found.index_i[has_depth]], seen.segments.endpoints[found.index_j[has_depth]]
        before = motion
        # Not `gauss_newton`: the weights follow the scale of the residuals, so that there is no energy that must fall.
        for _ in range(ITERATIONS):
            rows = _rows(segments, own, theirs, motion, intrinsics)
            step = _step(rows, motion, start, known)
            motion = exponential(step) @ motion
            if np.abs(step).max() < CONVERGED:
                break
        rows = _rows(segments, own, theirs, motion, intrinsics)
        believed = known + _normal(rows.jacobian, _weights(rows.residual))
        if np.abs(tangent(motion @ rigid.invert(before))).max() < SYSTEMATIC[0]:  # the same segments would match
            break
    assert rows is not None
    weight = _weights(rows.residual)
    if not weight.any():
        return None
    agreed = int(np.count_nonzero((np.abs(rows.residual) < 3.0).all(1)))
    information = _without_chance(_normal(rows.jacobian, weight), _normal(rows.sliding, weight))
    return AlignedLines(motion, information, agreed, _visible(segments, motion, intrinsics, source))


def _miss(known: np.ndarray, segments: SpaceSegments, intrinsics: np.ndarray) -> float:
    """Return the image motion of segments at median depth for a pose error of information `known`, pixels."""
    shift, turn = worst_sigma(known)
    return min(float(intrinsics[0]) * float(np.hypot(turn, shift * np.median(segments.inverse_depth))), MAX_MISS)


@dataclass(frozen=True, eq=False)
class _Rows:
    """jacobian: [m, 2, 6] and residual: [m, 2], in standard deviations; a residual behind the camera is infinite.
    sliding: [m, 2, 6], standard deviation of the Jacobian: noise rotates the observed line, so that motion along it
    appears to be constrained.
    """

    jacobian: np.ndarray
    residual: np.ndarray
    sliding: np.ndarray


def _rows(
    segments: SpaceSegments, own: np.ndarray, theirs: np.ndarray, motion: np.ndarray, intrinsics: np.ndarray
) -> _Rows:
    turned = segments.rays[own] @ motion[:3, :3].T
    inverse = segments.inverse_depth[own][..., None]
    local = turned / inverse + motion[:3, 3]
    front = local[..., 2] > MIN_DEPTH
    # Any point before the camera: the residual of this end is set to infinity below, and its weight is zero.
    safe = np.where(front[..., None], local, [0.0, 0.0, 1.0])
    line = line_coefficients(theirs)
    pixels = pinhole.project(safe, intrinsics)
    row_x, row_y = (r.T.reshape(*safe.shape[:2], 6) for r in pinhole.projection_rows(safe.reshape(-1, 3), intrinsics))
    jacobian = line[:, None, :1] * row_x + line[:, None, 1:2] * row_y
    residual = (pixels * line[:, None, :2]).sum(2) + line[:, None, 2]
    # d X / d d = -ray / d^2, turned: the projection's derivative by X is the first three columns.
    by_depth = -(jacobian[..., :3] * turned).sum(2) / inverse[..., 0] ** 2
    along = theirs[:, 1] - theirs[:, 0]
    squared = (along**2).sum(1)[:, None]
    u = ((pixels - theirs[:, :1]) * along[:, None]).sum(2) / squared
    # `sigma^2` of the module docstring; the 1 is the end in the keyframe itself.
    variance = END_SIGMA**2 * ((1 - u) ** 2 + u**2 + 1.0) + (by_depth * segments.sigma[own]) ** 2
    sigma = np.sqrt(variance)
    sliding = (along[:, None, :1] * row_x + along[:, None, 1:] * row_y) * (np.sqrt(2.0) * END_SIGMA / squared)[
        ..., None
    ]
    return _Rows(jacobian / sigma[..., None], np.where(front, residual / sigma, np.inf), sliding / sigma[..., None])


def _without_chance(hessian: np.ndarray, by_chance: np.ndarray) -> np.ndarray:
    """Return the information without that of noise in the Jacobian, `E[J' J] - J0' J0`.

    Otherwise parallel lines, each slightly rotated by noise, would appear to constrain the motion along them.
    """
    # Relative to the information of all lines, so that a direction is judged by its share of chance, whatever its unit.
    root = np.linalg.cholesky(hessian + ROUNDING * np.trace(hessian) * np.eye(6))
    half = np.linalg.solve(root, by_chance)
    share, basis = np.linalg.eigh(np.linalg.solve(root, half.T))
    left = root @ basis
    return (left * np.maximum(1.0 - share, 0.0)) @ left.T


def _weights(residual: np.ndarray) -> np.ndarray:
    """Return Tukey's weights; larger residuals than expected widen the kernel and lower all weights."""
    finite = np.isfinite(residual)
    scale = max(sigma_by_median(residual[finite]), 1.0) if finite.any() else 1.0
    inside = np.where(finite, residual / (TUKEY * scale), 1.0)
    return np.maximum(1.0 - inside**2, 0.0) ** 2 / scale**2


def _step(rows: _Rows, motion: np.ndarray, start: np.ndarray, known: np.ndarray) -> np.ndarray:
    weight = _weights(rows.residual)
    safe = np.where(np.isfinite(rows.residual), rows.residual, 0.0)
    hessian = _normal(rows.jacobian, weight) + known
    gradient = np.einsum("mec,me->c", rows.jacobian, weight * safe) + known @ tangent(motion @ rigid.invert(start))
    # Lines may leave a direction free: it gets no step.
    return damped_step(hessian, gradient)


def _normal(jacobian: np.ndarray, weight: np.ndarray) -> np.ndarray:
    flat = jacobian.reshape(-1, 6)
    return (flat * weight.reshape(-1, 1)).T @ flat


def _visible(segments: SpaceSegments, motion: np.ndarray, intrinsics: np.ndarray, source: Keyframe) -> int:
    """Return the number of segments whose middle and at least one end are inside the image."""
    local = segments.rays / segments.inverse_depth[..., None] @ motion[:3, :3].T + motion[:3, 3]
    points = np.concatenate([local, local.mean(1, keepdims=True)], 1)
    height, width = source.size
    with np.errstate(invalid="ignore"):
        x, y = np.moveaxis(pinhole.project(points, intrinsics, MIN_DEPTH), -1, 0)
        inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    return int(np.count_nonzero(inside[:, 2] & inside[:, :2].any(1)))
