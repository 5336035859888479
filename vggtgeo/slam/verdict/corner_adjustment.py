"""The bundle adjustment that all hypotheses of the verdict share: a robust Gauss-Newton over corner tracks.

Unknowns: the pose of each frame `T_f` (world -> camera, left tangents), a point for each track, and the calibration
`theta`. A track's point is `[a, b, 1] / rho` in the camera that the run claims for the track's first frame; that pose
is constant, so this is only a chart of space that stays regular for far points. Residuals, divided by the noise:

- `f(theta) (n (1 + k1 |n|^2) + c(theta)) + readout shift - u`, `n` the normalised image point, 2 rows a corner;
- `log(z + offset) + drift(theta) - log z_measured`, 1 row where depth was measured.

Cauchy's kernel, as for Student's t likelihood with few degrees of freedom. Points are eliminated (3 x 3 blocks), and
the reduced system of poses and calibration is dense: at most `6 * 24 + 13` unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.gauss_newton import FIRST_DAMPING, SchurComplement, levenberg_marquardt
from vggtgeo.slam.verdict.claim import KNOTS, Tracks

KERNEL, BEHIND = 2.0, 1e3
"""Width of Cauchy's kernel, and residual of a point behind a camera, in standard deviations of the noise."""
TETHER = 1e-4
"""Information on each unknown of a pose: holds the scale of a map without depth, and a frame without corners."""
CONVERGED, LINEAR = 5e-4, 0.5
"""Relative decrease of the energy below which the iteration ends; share of the decrease that a step promises, below
which the points are solved once more for its poses."""
FOCAL = slice(0, KNOTS)
DRIFT = slice(KNOTS, 2 * KNOTS)
CENTRE = slice(2 * KNOTS, 2 * KNOTS + 2)
RADIAL, READOUT, OFFSET = 2 * KNOTS + 2, 2 * KNOTS + 3, 2 * KNOTS + 4
SIZE = 2 * KNOTS + 5
"""Layout of `theta`: log focal length at each knot; log depth factor at each knot; principal point, as a share of the
focal length; radial distortion k1; time from the first row to the last, s; metres added to the depth."""
HELD = np.zeros((SIZE, 0))
"""Columns of a calibration that is not free."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations: of a corner, pixels; of the logarithm of a measured depth."""

    pixel: float
    depth: float


@dataclass(frozen=True, eq=False)
class Unknowns:
    """poses: float64 [f, 4, 4]; points: float64 [t, 3]: `a, b, log rho`; theta: float64 [SIZE]."""

    poses: np.ndarray
    points: np.ndarray
    theta: np.ndarray


@dataclass(frozen=True, eq=False)
class Fit:
    """Tracks at some unknowns, those of a minimum after `solve`; the residuals there, and their derivatives. columns:
    float64 [SIZE, k], what of the calibration is free. residual: [m, 3], whitened; weight: [m, 3], robust. by_pose:
    [m, 3, 6]; by_point: [m, 3, 3]; by_theta: [m, 3, SIZE]. loss: [m], minus twice the robust log likelihood of each
    corner with its depth.
    """

    tracks: Tracks
    noise: Noise
    unknowns: Unknowns
    columns: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    by_pose: np.ndarray
    by_point: np.ndarray
    by_theta: np.ndarray
    loss: np.ndarray

    @property
    def energy(self) -> float:
        return float(self.loss.sum())

    def part(self, kept: np.ndarray) -> tuple[Tracks, Unknowns, Noise]:
        """Return the arguments with which `solve` continues for the tracks of which `kept`, bool [t], is true."""
        return self.tracks.subset(kept), replace(self.unknowns, points=self.unknowns.points[kept]), self.noise


def linearise(tracks: Tracks, unknowns: Unknowns, noise: Noise, columns: np.ndarray = HELD) -> Fit:
    """Return residuals and their derivatives at some unknowns."""
    theta, knots, count = unknowns.theta, tracks.knots, len(tracks.frame)
    relative = unknowns.poses[tracks.frame] @ tracks.from_anchor
    a, b, log_inverse = unknowns.points[tracks.track].T
    inverse = np.exp(log_inverse)
    turn, shift = relative[:, :3, :3], relative[:, :3, 3] * inverse[:, None]
    # The point in the camera times its inverse depth `rho`: finite for points at infinity.
    scaled = turn[:, :, 0] * a[:, None] + turn[:, :, 1] * b[:, None] + turn[:, :, 2] + shift
    behind = scaled[:, 2] < 1e-3
    scaled[behind] = 0.0, 0.0, 1.0

    z = scaled[:, 2]
    normalised = scaled[:, :2] / z[:, None]
    squared = np.sum(normalised**2, 1)[:, None]
    stretch = 1.0 + theta[RADIAL] * squared
    focal = np.exp(knots @ theta[FOCAL])[:, None] * tracks.intrinsics[:2]
    seen = focal * (normalised * stretch + theta[CENTRE])
    depth = np.maximum(z / inverse + theta[OFFSET], 1e-3)
    pixels = seen + tracks.intrinsics[2:] + theta[READOUT] * tracks.readout
    predicted = np.column_stack([pixels, np.log(depth) + knots @ theta[DRIFT]])

    bent = 2.0 * theta[RADIAL] * normalised[:, :, None] * normalised[:, None, :]
    by_scaled, by_theta = np.zeros((count, 3, 3)), np.zeros((count, 3, SIZE))
    by_scaled[:, :2, :2] = focal[:, :, None] * (bent + stretch[:, :, None] * np.eye(2)) / z[:, None, None]
    by_scaled[:, :2, 2] = -(by_scaled[:, :2, :2] @ normalised[:, :, None])[:, :, 0]
    by_scaled[:, 2, 2] = 1.0 / (inverse * depth)
    by_theta[:, :2, FOCAL] = seen[:, :, None] * knots[:, None]
    by_theta[:, :2, CENTRE] = focal[:, :, None] * np.eye(2)
    by_theta[:, :2, RADIAL] = focal * normalised * squared
    by_theta[:, :2, READOUT] = tracks.readout
    by_theta[:, 2, DRIFT] = knots
    by_theta[:, 2, OFFSET] = 1.0 / depth
    by_point = by_scaled @ np.stack([turn[:, :, 0], turn[:, :, 1], shift], 2)
    by_point[:, 2, 2] -= z / (inverse * depth)
    by_pose = np.concatenate([by_scaled * inverse[:, None, None], by_scaled @ -rigid.skew(scaled)], 2)

    measured, whiten = _measured(tracks, noise, behind)
    residual = (predicted - measured) * whiten
    square = np.column_stack([np.sum(residual[:, :2] ** 2, 1), residual[:, 2] ** 2]) / KERNEL**2
    square[behind, 0] = (BEHIND / KERNEL) ** 2
    weight = (1.0 / (1.0 + square))[:, [0, 0, 1]]
    loss = KERNEL**2 * np.log1p(square).sum(1)
    by_pose, by_point, by_theta = (whiten[:, :, None] * by for by in (by_pose, by_point, by_theta))
    return Fit(tracks, noise, unknowns, columns, residual, weight, by_pose, by_point, by_theta, loss)


def _measured(tracks: Tracks, noise: Noise, behind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels and logarithm of the depth of each corner [m, 3], and one over their standard deviations [m, 3].

    Both are zero where nothing was measured, and for points `behind` a camera, bool [m].
    """
    measured = np.column_stack([tracks.pixels, np.log(tracks.depth)])
    known = np.isfinite(measured) & ~behind[:, None]
    # The error of a measured depth is common to its track.
    sigma = np.column_stack([np.full((len(measured), 2), noise.pixel), noise.depth * np.sqrt(tracks.depths)])
    return np.where(known, measured, 0.0), np.where(known, 1.0 / sigma, 0.0)


def reduce(fit: Fit, columns: np.ndarray, poses_free: bool, damping: float) -> SchurComplement:
    """Eliminate the points. columns: float64 [SIZE, k], what of the calibration is free."""
    # The negative residual goes along as one more column: what becomes of it is the right-hand side.
    tracks = fit.tracks
    frames, count = len(tracks.poses), len(tracks.first)
    weighted = lambda by: np.swapaxes(by * fit.weight[:, :, None], 1, 2)
    rest = np.concatenate([fit.by_theta @ columns, -fit.residual[:, :, None]], 2)
    point, width = weighted(fit.by_point), 6 * frames * poses_free
    size = width + rest.shape[2]
    coupling, matrix = np.zeros((count, 3, size)), np.zeros((size, size))
    coupling[:, :, width:] = tracks.sums(point @ rest)
    matrix[width:, width:] = np.tensordot(rest * fit.weight[:, :, None], rest, ((0, 1), (0, 1)))
    if poses_free:
        pose, each = weighted(fit.by_pose), np.arange(frames)
        of_frames = lambda values: np.tensordot(1.0 * (tracks.frame == each[:, None]), values, 1)
        coupling[:, :, :width].reshape(count, 3, frames, 6)[tracks.track, :, tracks.frame] = point @ fit.by_pose
        matrix[:width, :width].reshape(frames, 6, frames, 6)[each, :, each] = of_frames(pose @ fit.by_pose)
        matrix[:width, width:] = of_frames(pose @ rest).reshape(width, -1)
        matrix[width:, :width] = matrix[:width, width:].T
    diagonal = np.arange(size - 1)
    matrix[diagonal, diagonal] *= 1.0 + damping
    matrix[diagonal[:width], diagonal[:width]] += TETHER
    blocks = tracks.sums(point @ fit.by_point)
    blocks[:, range(3), range(3)] *= 1.0 + damping
    return SchurComplement.of(matrix, coupling, blocks + 1e-6 * np.eye(3))


def solve(
    tracks: Tracks, start: Unknowns, noise: Noise, columns: np.ndarray = HELD, poses_free: bool = True, steps: int = 12
) -> Fit:
    """Minimise over points, poses where `poses_free`, and the calibration's `columns` (float64 [SIZE, k])."""
    width = 6 * len(tracks.poses) * poses_free
    free = slice(6 * poses_free, None)  # the first pose fixes the gauge

    def stepped(fit: Fit, damping: float) -> Fit:
        reduced, old = reduce(fit, columns, poses_free, damping), fit.unknowns
        step = np.zeros(len(reduced.side))
        step[free] = np.linalg.solve(reduced.matrix[free, free], reduced.side[free])
        poses = rigid.moved(old.poses, step[:width].reshape(-1, 6)) if poses_free else old.poses
        points = old.points + np.clip(reduced.landmarks(step), -1.0, 1.0)
        new = Unknowns(poses, points, old.theta + columns @ step[width:])
        there = linearise(tracks, new, noise, columns)
        if len(step) and fit.energy - there.energy < LINEAR * reduced.gain(step):
            # Points follow a long step of poses and focal length on a curve; without a step of their own the iteration
            # creeps along it (embedded point iterations, Jeong et al. 2012).
            own = reduce(there, HELD, False, FIRST_DAMPING).landmarks(np.zeros(0))
            there = linearise(tracks, replace(new, points=points + np.clip(own, -1.0, 1.0)), noise, columns)
        return there

    first = linearise(tracks, start, noise, columns)
    return levenberg_marquardt(first, lambda fit: fit.energy, stepped, steps=steps, gain=CONVERGED)


def start_of(tracks: Tracks) -> Unknowns:
    """Triangulate points with the claimed poses, in front of the cameras."""
    relative = tracks.poses[tracks.frame] @ tracks.from_anchor
    rays = pinhole.rays(tracks.pixels, tracks.intrinsics)
    own = rays[tracks.first]
    turned = (relative[:, :3, :3] @ own[tracks.track][:, :, None])[:, :, 0]
    lever = rigid.cross(relative[:, :3, 3], rays)
    information = np.maximum(tracks.sums(np.sum(lever**2, 1)), 1e-12)
    value = tracks.sums(-np.sum(lever * rigid.cross(turned, rays), 1)) / information
    triangulated = np.where(value > 0, value, np.nan)
    measured = 1.0 / tracks.depth[tracks.first]
    usual = measured if np.isfinite(measured).any() else triangulated
    middle = float(np.nanmedian(usual)) if np.isfinite(usual).any() else 1.0
    inverse = np.where(np.isfinite(measured), measured, triangulated)
    inverse = np.clip(np.nan_to_num(inverse, nan=middle), 0.02 * middle, 20.0 * middle)
    return Unknowns(tracks.poses, np.column_stack([own[:, :2], np.log(inverse)]), np.zeros(SIZE))
