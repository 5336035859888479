"""The bundle adjustment that all hypotheses of the verdict share: a robust Gauss-Newton over corner tracks.

Unknowns: the pose of each frame `T_f` (world -> camera, left tangents), a point for each track, and the calibration
`theta` (`Calibration`). A track's point is `[a, b, 1] / rho` in the camera that the run claims for the track's first
frame; that pose is constant, so this is only a chart of space that stays regular for far points. Residuals, divided by
the noise:

- `f(theta) d(n; theta) + c(theta) + readout shift - u`, `n` the normalised image point, 2 rows a corner;
- `log z + drift(theta) - log z_measured`, 1 row where depth was measured.

Cauchy's kernel, as for Student's t likelihood with few degrees of freedom. Points are eliminated (3 x 3 blocks), and
the reduced system of poses and calibration is dense: at most `6 * 24 + 13` unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vggtgeo.geometry import rigid

KERNEL = 2.0
"""Width of Cauchy's kernel, in standard deviations of the noise."""
TETHER = 1e-4
"""Information on each unknown of a pose: holds the scale of a map without depth, and a frame without corners."""
ITERATIONS, CONVERGED = 12, 5e-4
"""At most; and the relative decrease of the energy below which the iteration ends."""
FIRST_DAMPING, LAST_DAMPING = 1e-5, 1e3
"""Of Levenberg and Marquardt, as a share of the diagonal."""
LINEAR = 0.5
"""Of the decrease of the energy that a step promises: with less, the points are solved once more for its poses."""
KNOTS = 4
"""Of a quantity that changes with time: linear between so many moments, evenly spread over the window."""
FOCAL = slice(0, KNOTS)
DRIFT = slice(KNOTS, 2 * KNOTS)
CENTRE = slice(2 * KNOTS, 2 * KNOTS + 2)
RADIAL, READOUT, OFFSET = 2 * KNOTS + 2, 2 * KNOTS + 3, 2 * KNOTS + 4
SIZE = 2 * KNOTS + 5
"""Layout of `theta`: log focal length at each knot; log depth factor at each knot; principal point, as a share of the
focal length; radial distortion k1; time from the first row to the last, s; metres added to the depth."""
HUGE = 1e3
"""Whitened residual of a point behind a camera."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Corner tracks of a few frames, and what the run claims of these.

    rows: int [f], of the run. times: float64 [f], s. poses: float64 [f, 4, 4], world -> camera. intrinsics: fx, fy, cx,
    cy. size: width, height, pixels. frame, track: int [m], of each observation, sorted by track. pixels: float64
    [m, 2]. depth: float64 [m], metres, NaN where it was not measured or the map is not metric. readout: float64
    [m, 2], pixels by which a rolling shutter of one second moves the corner. first: int [t], first observation of each
    track.
    """

    rows: np.ndarray
    times: np.ndarray
    poses: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    frame: np.ndarray
    track: np.ndarray
    pixels: np.ndarray
    depth: np.ndarray
    readout: np.ndarray
    first: np.ndarray

    @property
    def depths(self) -> np.ndarray:
        """How many measured depths the track of each observation has, at least 1, float64 [m]."""
        known = np.add.reduceat(np.isfinite(self.depth).astype(np.float64), self.first)
        return np.asarray(np.maximum(known, 1.0)[self.track])

    @property
    def anchor(self) -> np.ndarray:
        """Frame in whose claimed camera each track's point is expressed, int [t]."""
        return self.frame[self.first]

    def knots(self) -> np.ndarray:
        """Weights that interpolate between the knots, of each observation: float64 [m, KNOTS]."""
        span = max(float(self.times[-1] - self.times[0]), 1e-9)
        at = (self.times - self.times[0]) / span * (KNOTS - 1)
        return np.maximum(1.0 - np.abs(at[:, None] - np.arange(KNOTS)), 0.0)[self.frame]


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations: of a corner, pixels; of the logarithm of a measured depth, near the camera, and its growth a
    metre: what is triangulated (stereo, a pattern) has an error that grows with the square of the distance.
    """

    pixel: float
    depth: float
    growth: float = 0.0

    def of_depth(self, metres: np.ndarray) -> np.ndarray:
        """Of the logarithm of depths measured at these distances."""
        return np.hypot(self.depth, self.growth * metres)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """poses: float64 [f, 4, 4]; points: float64 [t, 3]: `a, b, log rho`; theta: float64 [SIZE]."""

    poses: np.ndarray
    points: np.ndarray
    theta: np.ndarray


@dataclass(frozen=True, eq=False)
class Linear:
    """Residuals, whitened, [m, 3], robust weights [m, 3], derivatives by pose [m, 3, 6], point [m, 3, 3] and
    calibration [m, 3, SIZE]; energy: minus twice the robust log likelihood.
    """

    residual: np.ndarray
    weight: np.ndarray
    by_pose: np.ndarray
    by_point: np.ndarray
    by_theta: np.ndarray
    energies: np.ndarray

    @property
    def energy(self) -> float:
        """Of all observations."""
        return float(self.energies.sum())


@dataclass(frozen=True, eq=False)
class Prediction:
    """Pixels and log depth of each observation, value [m, 3], and derivatives: by the point in the camera times its
    inverse depth `rho` [m, 3, 3], by `log rho` [m, 3], and by the calibration [m, 3, SIZE].
    """

    value: np.ndarray
    by_numerator: np.ndarray
    by_log: np.ndarray
    by_theta: np.ndarray


def predict(tracks: Tracks, numerator: np.ndarray, log_inverse: np.ndarray, theta: np.ndarray) -> Prediction:
    """What is seen of points.

    numerator: float64 [m, 3], point in the camera times its `rho`. log_inverse: float64 [m], `log rho`.
    """
    count, z, inverse, weights = len(numerator), numerator[:, 2], np.exp(log_inverse), tracks.knots()
    normalised = numerator[:, :2] / z[:, None]
    squared = np.sum(normalised**2, 1)[:, None]
    stretch = 1.0 + theta[RADIAL] * squared
    focal = np.exp(weights @ theta[FOCAL])[:, None] * tracks.intrinsics[:2]
    seen = focal * (normalised * stretch + theta[CENTRE])
    depth = np.maximum(z / inverse + theta[OFFSET], 1e-3)
    value = np.column_stack(
        [seen + tracks.intrinsics[2:] + theta[READOUT] * tracks.readout, np.log(depth) + weights @ theta[DRIFT]]
    )
    by_normalised = 2.0 * theta[RADIAL] * normalised[:, :, None] * normalised[:, None, :]
    by_normalised = focal[:, :, None] * (by_normalised + stretch[:, :, None] * np.eye(2))
    by_numerator, by_log, by_theta = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3, SIZE))
    by_numerator[:, :2, :2] = by_normalised / z[:, None, None]
    by_numerator[:, :2, 2] = -np.einsum("mij,mj->mi", by_normalised, normalised) / z[:, None]
    by_numerator[:, 2, 2] = 1.0 / (inverse * depth)
    by_log[:, 2] = -z / (inverse * depth)
    by_theta[:, :2, FOCAL] = seen[:, :, None] * weights[:, None]
    by_theta[:, :2, CENTRE] = focal[:, :, None] * np.eye(2)
    by_theta[:, :2, RADIAL] = focal * normalised * squared
    by_theta[:, :2, READOUT] = tracks.readout
    by_theta[:, 2, DRIFT] = weights
    by_theta[:, 2, OFFSET] = 1.0 / depth
    return Prediction(value, by_numerator, by_log, by_theta)


def linearise(tracks: Tracks, unknowns: Unknowns, noise: Noise) -> Linear:
    """Residuals and their derivatives there."""
    relative = unknowns.poses[tracks.frame] @ rigid.invert(tracks.poses[tracks.anchor])[tracks.track]
    a, b, log_inverse = unknowns.points[tracks.track].T
    inverse = np.exp(log_inverse)
    turn, shift = relative[:, :3, :3], relative[:, :3, 3] * inverse[:, None]
    numerator = turn[:, :, 0] * a[:, None] + turn[:, :, 1] * b[:, None] + turn[:, :, 2] + shift
    behind = numerator[:, 2] < 1e-3
    numerator = np.where(behind[:, None], [0.0, 0.0, 1.0], numerator)
    seen = predict(tracks, numerator, log_inverse, unknowns.theta)
    measured = np.column_stack([tracks.pixels, np.log(tracks.depth)])
    scale = np.full((len(a), 3), 1.0 / noise.pixel)
    # The error of a measured depth is common to its track.
    scale[:, 2] = 1.0 / (noise.of_depth(np.nan_to_num(tracks.depth)) * np.sqrt(tracks.depths))
    known = np.isfinite(measured) & ~behind[:, None]
    residual = np.where(known, (seen.value - np.where(known, measured, 0.0)) * scale, 0.0)
    mask = (known * scale)[:, :, None]
    none = np.zeros(len(a))
    x, y, z = numerator.T
    cross = np.stack([none, z, -y, -z, none, x, y, -x, none], 1).reshape(-1, 3, 3)
    by_pose = mask * np.concatenate([seen.by_numerator * inverse[:, None, None], seen.by_numerator @ cross], 2)
    by_point = seen.by_numerator @ np.stack([turn[:, :, 0], turn[:, :, 1], shift], 2)
    by_point[:, :, 2] += seen.by_log
    squared = np.column_stack([np.sum(residual[:, :2] ** 2, 1), residual[:, 2] ** 2])
    squared[:, 0] = np.where(behind, HUGE**2, squared[:, 0])
    energies = KERNEL**2 * np.log1p(squared / KERNEL**2).sum(1)
    weight = (1.0 / (1.0 + squared / KERNEL**2))[:, [0, 0, 1]]
    return Linear(residual, weight, by_pose, mask * by_point, mask * seen.by_theta, energies)


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations after the points are eliminated: matrix [n, n] and right-hand side [n] of poses, then
    calibration; and what gives the points back: `factor` [t, 3, 3] (inverse of Cholesky's), `both` [t, 3, n], `side`
    [t, 3], both times the factor.
    """

    matrix: np.ndarray
    side: np.ndarray
    factor: np.ndarray
    both: np.ndarray
    point_side: np.ndarray

    def points(self, step: np.ndarray) -> np.ndarray:
        """Step of the points, [t, 3], that belongs to one of the rest, [n]."""
        return np.einsum("tji,tj->ti", self.factor, self.point_side - self.both @ step)


def reduce(tracks: Tracks, linear: Linear, columns: np.ndarray, poses_free: bool, damping: float) -> Reduced:
    """Eliminate the points. columns: float64 [SIZE, k], what of the calibration is free."""
    frames, count = len(tracks.poses), len(tracks.first)
    width = 6 * frames * poses_free
    extra = linear.by_theta @ columns
    weighted = linear.by_point * linear.weight[:, :, None]
    sums = lambda values: np.add.reduceat(values, tracks.first, axis=0)
    own = sums(np.einsum("mri,mrj->mij", weighted, linear.by_point))
    own[:, range(3), range(3)] *= 1.0 + damping
    own += 1e-6 * np.eye(3)
    factor = np.linalg.inv(np.linalg.cholesky(own))
    both = np.zeros((count, 3, width + extra.shape[2]))
    if poses_free:
        cross = np.einsum("mri,mrj->mij", weighted, linear.by_pose)
        both[:, :, :width].reshape(count, 3, frames, 6)[tracks.track, :, tracks.frame] = cross
    both[:, :, width:] = sums(np.einsum("mri,mrj->mij", weighted, extra))
    both = factor @ both
    point_side = np.einsum("tij,tj->ti", factor, -sums(np.einsum("mri,mr->mi", weighted, linear.residual)))
    size = width + extra.shape[2]
    matrix, side = np.zeros((size, size)), np.zeros(size)
    if poses_free:
        moved = linear.by_pose * linear.weight[:, :, None]
        seen_by = (tracks.frame == np.arange(frames)[:, None]).astype(np.float64)
        of_frames = lambda values: (seen_by @ values.reshape(len(values), -1)).reshape(frames, *values.shape[1:])
        blocks = of_frames(np.einsum("mri,mrj->mij", moved, linear.by_pose))
        inside = np.arange(width).reshape(frames, 6)
        matrix[inside[:, :, None], inside[:, None, :]] = blocks
        side[:width] = of_frames(-np.einsum("mri,mr->mi", moved, linear.residual)).ravel()
        matrix[:width, width:] = of_frames(np.einsum("mri,mrj->mij", moved, extra)).reshape(width, -1)
        matrix[width:, :width] = matrix[:width, width:].T
    weighted_extra = extra * linear.weight[:, :, None]
    matrix[width:, width:] = np.einsum("mri,mrj->ij", weighted_extra, extra)
    side[width:] = -np.einsum("mri,mr->i", weighted_extra, linear.residual)
    diagonal = np.arange(size)
    matrix[diagonal, diagonal] *= 1.0 + damping
    matrix[diagonal[:width], diagonal[:width]] += TETHER
    flat = both.reshape(3 * count, size)
    return Reduced(matrix - flat.T @ flat, side - flat.T @ point_side.ravel(), factor, both, point_side)


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum: the unknowns, the linearisation there, and what was free."""

    unknowns: Unknowns
    linear: Linear
    columns: np.ndarray
    poses_free: bool

    @property
    def energy(self) -> float:
        """Minus twice the robust log likelihood."""
        return self.linear.energy


def solve(
    tracks: Tracks,
    start: Unknowns,
    noise: Noise,
    columns: np.ndarray | None = None,
    poses_free: bool = True,
    iterations: int = ITERATIONS,
) -> Fit:
    """Minimise over points, poses where `poses_free`, and the calibration's `columns` (float64 [SIZE, k])."""
    columns = np.zeros((SIZE, 0)) if columns is None else columns
    unknowns, damping = start, FIRST_DAMPING
    linear = linearise(tracks, unknowns, noise)
    width = 6 * len(tracks.poses) * poses_free
    free = slice(6 * poses_free, None)  # the first pose fixes the gauge
    for _ in range(iterations):
        reduced = reduce(tracks, linear, columns, poses_free, damping)
        step = np.zeros(len(reduced.side))
        if len(step[free]):
            step[free] = np.linalg.solve(reduced.matrix[free, free], reduced.side[free])
        poses = rigid.moved(unknowns.poses, step[:width].reshape(-1, 6)) if poses_free else unknowns.poses
        points = unknowns.points + np.clip(reduced.points(step), -1.0, 1.0)
        tried = Unknowns(poses, points, unknowns.theta + columns @ step[width:])
        there = linearise(tracks, tried, noise)
        expected = float(np.sum(reduced.point_side**2) + reduced.side @ step)
        if len(step) and linear.energy - there.energy < LINEAR * expected:
            tried = _with_own_points(tracks, tried, noise)
            there = linearise(tracks, tried, noise)
        if not there.energy < linear.energy:
            damping *= 10.0
            if damping > LAST_DAMPING:
                break
            continue
        ended = linear.energy - there.energy < CONVERGED * linear.energy
        unknowns, linear, damping = tried, there, max(damping / 10.0, 1e-10)
        if ended:
            break
    return Fit(unknowns, linear, columns, poses_free)


def _with_own_points(tracks: Tracks, unknowns: Unknowns, noise: Noise) -> Unknowns:
    """After a step of the points alone: points follow a long step of poses and focal length on a curve, and without
    this the iteration creeps along it (embedded point iterations, Jeong et al. 2012).
    """
    linear = linearise(tracks, unknowns, noise)
    reduced = reduce(tracks, linear, np.zeros((SIZE, 0)), False, FIRST_DAMPING)
    return replace(unknowns, points=unknowns.points + np.clip(reduced.points(np.zeros(0)), -1.0, 1.0))


def start_of(tracks: Tracks) -> Unknowns:
    """Points triangulated with the claimed poses, in front of the cameras."""
    relative = tracks.poses[tracks.frame] @ rigid.invert(tracks.poses[tracks.anchor])[tracks.track]
    rays = (tracks.pixels - tracks.intrinsics[2:]) / tracks.intrinsics[:2]
    rays = np.column_stack([rays, np.ones(len(rays))])
    own = rays[tracks.first]
    turned = np.einsum("mij,mj->mi", relative[:, :3, :3], own[tracks.track])
    lever = np.cross(relative[:, :3, 3], rays)
    sums = lambda values: np.add.reduceat(values, tracks.first)
    information = sums(np.sum(lever**2, 1))
    value = sums(-np.sum(lever * np.cross(turned, rays), 1)) / np.maximum(information, 1e-12)
    known = (value > 0) & (information > 0)
    middle = float(np.median(value[known])) if known.any() else 1.0
    measured = 1.0 / tracks.depth[tracks.first]
    if np.isfinite(measured).any():
        middle = float(np.nanmedian(measured))
    inverse = np.where(np.isfinite(measured), measured, np.where(known, value, middle))
    inverse = np.clip(inverse, 0.02 * middle, 20.0 * middle)
    return Unknowns(tracks.poses, np.column_stack([own[:, :2], np.log(inverse)]), np.zeros(SIZE))


def subset(tracks: Tracks, kept: np.ndarray) -> tuple[Tracks, np.ndarray]:
    """The tracks of which `kept`, bool [t], is true, and their numbers."""
    rows = kept[tracks.track]
    numbers = np.flatnonzero(kept)
    track = (np.cumsum(kept) - 1)[tracks.track[rows]]
    first = np.flatnonzero(np.r_[True, track[1:] != track[:-1]])
    parts = {name: getattr(tracks, name)[rows] for name in ("frame", "pixels", "depth", "readout")}
    return replace(tracks, **parts, track=track, first=first), numbers
