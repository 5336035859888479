"""The noise model of the verdict, estimated from the run itself. Everything that is called significant uses this file.

- A corner has the standard deviation `pixel`, a measured depth the relative one `depth`, both by the median absolute
  deviation of the residuals with free poses, corrected for the unknowns that these residuals determine.
- The depth errors of a track are common to it (an edge, a material): `n` depths of a track weigh as one.
- Errors are not independent along a track, which drifts, nor within a frame. So covariances are cluster-robust, by
  track and by frame (two-way, Cameron, Gelbach & Miller 2011): with the score `g_o` of each observation, and `H` the
  reduced information of the parameters that are asked for,

      V = H^-1 (sum_track G G' + sum_frame G G' - sum_o g_o g_o') H^-1,   G the sum of the scores of a cluster.

  `V H` is the number of observations that count as one.

- A track that follows the wrong corner is wrong in all its frames, and free poses fit some of these. So likelihoods are
  compared track by track (Vuong 1989): the sum of the gains must exceed what their scatter makes by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from vggtgeo.slam.verdict.corner_adjustment import SIZE, Fit, Noise, reduce, solve, start_of
from vggtgeo.slam.verdict.thresholds import MIN_PIXEL_NOISE, MIN_RELATIVE_DEPTH_NOISE, SIGNIFICANCE


def with_own_noise(fit: Fit) -> Fit:
    """Repeat a fit with the noise that its residuals show."""
    return solve(fit.tracks, fit.unknowns, estimated(fit), fit.columns)


def estimated(fit: Fit) -> Noise:
    """Estimate the noise from the residuals of a fit with free poses."""
    tracks, noise, residual = fit.tracks, fit.noise, fit.linear.residual
    count = 2 * len(tracks.frame)
    freedom = max(count - 3 * len(tracks.first) - 6 * len(tracks.rows), 0.15 * count)
    pixel = noise.pixel * _deviation(residual[:, :2]) * np.sqrt(count / freedom)
    known = np.isfinite(tracks.depth)
    shared = residual[known, 2] * np.sqrt(tracks.depths[known])  # the error of a depth is common to its track
    depth = noise.depth * _deviation(shared) if known.any() else noise.depth
    return Noise(max(float(pixel), MIN_PIXEL_NOISE), max(depth, MIN_RELATIVE_DEPTH_NOISE))


def preferred(fit: Fit) -> bool:
    """Return whether the tracks prefer a fit with free poses to the claim, beyond chance, its unknowns paid for."""
    tracks = fit.tracks
    claim = solve(tracks, start_of(tracks), fit.noise, poses_free=False)
    gain = tracks.sums(claim.linear.loss - fit.linear.loss)
    unknowns = 6 * (len(tracks.rows) - 1) + fit.columns.shape[1]
    return bool(gain.sum() - unknowns > norm.isf(SIGNIFICANCE) * np.sqrt(len(gain)) * gain.std())


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

    def gain(self, columns: np.ndarray) -> float:
        """Return the decrease of minus twice the log likelihood that a linear step of `columns` promises."""
        side = columns.T @ self.side
        return float(side @ np.linalg.pinv(columns.T @ self.information @ columns, hermitian=True) @ side)

    def covariance(self, columns: np.ndarray) -> np.ndarray:
        """Return the robust covariance of the calibration's `columns` [SIZE, k], float64 [k, k]."""
        inverse = np.linalg.pinv(columns.T @ self.information @ columns, hermitian=True)
        return np.asarray(inverse @ (columns.T @ self.clustered @ columns) @ inverse + 1e-3 * inverse)

    @property
    def as_one(self) -> float:
        """Observations that count as one, in the mean over the directions that the corners determine."""
        information = np.diag(self.information)
        known = np.flatnonzero(information > 0)
        each = [self.covariance(np.eye(SIZE)[:, [place]])[0, 0] * information[place] for place in known]
        return max(float(np.mean(each)), 1.0) if each else 1.0


def scores(fit: Fit) -> Scores:
    """Return the scores of the whole calibration at a fit, whatever was free there."""
    tracks, linear = fit.tracks, fit.linear
    reduced = reduce(tracks, linear, np.eye(SIZE), True, 0.0)
    width = 6 * len(tracks.rows)
    poses = np.zeros((width, SIZE))
    poses[6:] = -np.linalg.solve(reduced.matrix[6:width, 6:width], reduced.matrix[6:width, width:])
    points = -np.swapaxes(reduced.inverse, 1, 2) @ (reduced.coupling @ np.vstack([poses, np.eye(SIZE)]))
    along = linear.by_theta + linear.by_point @ points[tracks.track]
    along += linear.by_pose @ poses.reshape(-1, 6, SIZE)[tracks.frame]
    weighted = along * linear.weight[:, :, None]
    each = -(np.swapaxes(weighted, 1, 2) @ linear.residual[:, :, None])[:, :, 0]
    # Second derivative of Cauchy's kernel over its weight: what the weights alone overstate of the information.
    square = np.sum(weighted * along, 2)
    curved = np.sum(square * (2.0 * linear.weight - 1.0)) / max(float(np.sum(square)), 1e-300)
    information = np.tensordot(weighted, along, ((0, 1), (0, 1)))
    clustered = _clustered(each, tracks.track) + _clustered(each, tracks.frame) - each.T @ each
    return Scores(each.sum(0), information, clustered / max(float(curved), 0.3) ** 2)


def _clustered(each: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Sum of squared scores of the clusters, about their mean: what all have in common is the signal."""
    sums = np.zeros((of.max() + 1, each.shape[1]))
    np.add.at(sums, of, each)
    sums -= sums.mean(0)
    return np.asarray(sums.T @ sums)
