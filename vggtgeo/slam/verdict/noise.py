"""The noise model of the verdict, estimated from the run itself. Everything that is called significant uses this file.

- A corner has the standard deviation `pixel`, a measured depth `hypot(depth, growth z)` (relative), both by the median
  absolute deviation of the residuals with free poses, corrected for the unknowns that these residuals determine.
- The depth errors of a track are common to it (an edge, a material): `n` depths of a track weigh as one.
- Errors are not independent along a track, which drifts, nor within a frame. So covariances are cluster-robust, by
  track and by frame (two-way, Cameron, Gelbach & Miller 2011): with the score `g_o` of each observation, and `H` the
  reduced information of the parameters that are asked for,

      V = H^-1 (sum_track G G' + sum_frame G G' - sum_o g_o g_o') H^-1,   G the sum of the scores of a cluster.

  `V H` is the number of observations that count as one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.slam.verdict.adjustment import SIZE, Fit, Noise, Tracks, linearise, reduce

MIN_PIXEL, MIN_DEPTH = 0.05, 0.003
"""Pixels and relative: below these a simulated recording without noise would find everything significant."""


def estimated(tracks: Tracks, fit: Fit, noise: Noise) -> Noise:
    """The noise by the residuals of a fit with free poses."""
    count = len(tracks.frame)
    unknowns = 3 * len(tracks.first) + 6 * len(tracks.rows)
    freedom = max(2 * count - unknowns, 0.3 * count)
    pixel = noise.pixel * _deviation(fit.linear.residual[:, :2]) * np.sqrt(2 * count / freedom)
    known = np.isfinite(tracks.depth)
    depth, growth = noise.depth, 0.0
    if known.any():
        metres = tracks.depth[known]
        error = fit.linear.residual[known, 2] * np.sqrt(tracks.depths[known]) * noise.of_depth(metres)
        depth, growth = _growing(np.abs(error), metres)
    return Noise(max(float(pixel), MIN_PIXEL), max(depth, MIN_DEPTH), growth)


def _growing(error: np.ndarray, metres: np.ndarray) -> tuple[float, float]:
    """Standard deviation at no distance, and its growth a metre, by the nearer and the farther half."""
    near = metres <= np.median(metres)
    parts = [(_deviation(error[part]), float(np.mean(metres[part] ** 2))) for part in (near, ~near) if part.any()]
    (first, close), (second, far) = parts[0], parts[-1]
    growth = max(second**2 - first**2, 0.0) / max(far - close, 1e-12)
    return float(np.sqrt(max(first**2 - growth * close, 0.0))), float(np.sqrt(growth))


def _deviation(values: np.ndarray) -> float:
    return 1.4826 * float(np.median(np.abs(values)))


@dataclass(frozen=True, eq=False)
class Scores:
    """The calibration's share of a fit, poses and points eliminated.

    side: float64 [SIZE], the score; information, clustered: [SIZE, SIZE], `H`, and the covariance of the score.
    """

    side: np.ndarray
    information: np.ndarray
    clustered: np.ndarray

    def step(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Linear estimate [k] of the calibration's `columns` [SIZE, k], its robust covariance [k, k], and how many
        observations count as one.
        """
        own = columns.T @ self.information @ columns
        inverse = np.linalg.pinv(own, hermitian=True)
        robust = inverse @ (columns.T @ self.clustered @ columns) @ inverse + 1e-3 * inverse
        as_one = max(float(np.trace(robust @ own)) / columns.shape[1], 1.0)
        return inverse @ columns.T @ self.side, robust, as_one

    @property
    def as_one(self) -> float:
        """Observations that count as one, in the mean over the directions that the corners determine."""
        determined = np.flatnonzero(np.diag(self.information) > 0)
        each = [self.step(np.eye(SIZE)[:, [place]])[2] for place in determined]
        return float(np.mean(each)) if each else 1.0


def scores(tracks: Tracks, fit: Fit, noise: Noise) -> Scores:
    """The scores of the calibration at a fit, all of it, whatever was free there."""
    linear = linearise(tracks, fit.unknowns, noise)
    reduced = reduce(tracks, linear, np.eye(SIZE), True, 0.0)
    width = 6 * len(tracks.rows)
    poses = np.zeros((width, SIZE))
    poses[6:] = -np.linalg.solve(reduced.matrix[6:width, 6:width], reduced.matrix[6:width, width:])
    points = -np.einsum("tji,tjn->tin", reduced.factor, reduced.both @ np.vstack([poses, np.eye(SIZE)]))
    along = linear.by_theta + linear.by_point @ points[tracks.track]
    along = along + linear.by_pose @ poses.reshape(-1, 6, SIZE)[tracks.frame]
    each = -np.einsum("mrk,mr->mk", along, linear.weight * linear.residual)
    # Second derivative of Cauchy's kernel over its weight: what the weights alone overstate of the information.
    weighted = along**2 * linear.weight[:, :, None]
    curved = np.sum(weighted * (2.0 * linear.weight - 1.0)[:, :, None]) / max(float(np.sum(weighted)), 1e-300)
    information = np.einsum("mri,mr,mrj->ij", along, linear.weight, along, optimize=True)
    clustered = _clustered(each, tracks.track) + _clustered(each, tracks.frame) - each.T @ each
    return Scores(each.sum(0), information, clustered / max(float(curved), 0.3) ** 2)


def _clustered(each: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Sum of squared scores of the clusters, about their mean: what all have in common is the signal."""
    sums = np.zeros((of.max() + 1, each.shape[1]))
    np.add.at(sums, of, each)
    sums -= sums.mean(0)
    return np.asarray(sums.T @ sums)
