"""The explanations that the verdict knows, and which of them the corners of a window prefer.

Each alternative is the run's claim with a few more free parameters (`TABLE`). All have free poses, so that a wrong
camera cannot hide behind poses that make up for it. The one of which a single linear step promises most (Rao's score
test) is solved, and taken if it is significant (Wald). Corners that another motion explains are set apart.

- The noise is that of the residuals with free poses, corrected for the unknowns that these determine. The depth errors
  of a track are common to it (an edge, a material): `n` depths of a track weigh as one.
- Errors are not independent along a track, which drifts, nor within a frame. So covariances are cluster-robust:
  `V = H^-1 C H^-1`, with the reduced information `H` of the parameters that are asked for, and the covariance `C` of
  their score, two-way clustered by track and frame. `V H` is the number of observations that count as one.
- A track that follows the wrong corner is wrong in all its frames, and free poses fit some of these. So likelihoods are
  compared track by track (Vuong 1989): the sum of the gains must exceed what their scatter makes by chance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtri, ndtri

from vggtgeo.geometry.robust import ClusteredScore, sigma_by_median, two_way_clustered
from vggtgeo.slam.verdict import corner_adjustment as theta
from vggtgeo.slam.verdict import thresholds
from vggtgeo.slam.verdict.claim import Tracks
from vggtgeo.slam.verdict.corner_adjustment import SIZE, Fit, Noise, reduce, solve, start_of
from vggtgeo.slam.verdict.thresholds import MIN_INLIER_WEIGHT, MIN_SECOND_MOTION_SHARE, SIGNIFICANCE

START = Noise(0.6, 0.03)
"""Pixels of an image of 320, relative: until residuals say more, which they do not where no depth was measured."""
WIDE, FIRST_STEPS = 20.0, 6
"""Times the noise in the first steps towards a second motion, which begin far from it, and their number."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """One hypothesis. columns: float64 [SIZE, k], directions of `theta` that it frees. factor, unit: the estimate times
    `factor` is in `unit`, for messages. estimate: float64 [k], covariance: [k, k], of a fit.
    """

    name: str
    columns: np.ndarray
    factor: float
    unit: str
    estimate: np.ndarray = field(default_factory=lambda: np.zeros(0))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))


EACH = np.eye(SIZE)
TABLE = (
    Alternative("focal length", EACH[:, theta.FOCAL].sum(1, keepdims=True), 100, "%"),
    Alternative("focal length", EACH[:, theta.FOCAL], 100, "% (at four moments)"),
    Alternative("principal point", EACH[:, theta.CENTRE], 100, "% of the focal length (right, down)"),
    Alternative("distortion", EACH[:, [theta.RADIAL]], 1, "(k1)"),
    Alternative("rolling shutter", EACH[:, [theta.READOUT]], 1000, "ms"),
    Alternative("depth", EACH[:, theta.DRIFT][:, 1:], 100, "% (later against the first moment)"),
    Alternative("depth", EACH[:, [theta.OFFSET]], 100, "cm"),
)
"""Those of depth promise nothing where none was measured. Poses alone and a second motion are explanations, too."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """What the corners of a window prefer. best: fit with free poses and what was added, without the corners of the
    second motion. added: None where no alternative is significant. share, rival: of the observations, explained by the
    first motion and by the second.
    """

    best: Fit
    added: Alternative | None
    share: float
    rival: float


def explain(tracks: Tracks) -> Explanation:
    """Return the preferred explanation of the tracks of a window."""
    noise = replace(START, pixel=START.pixel * max(tracks.size) / 320.0)
    held = solve(tracks, start_of(tracks), noise, poses_free=False, steps=4)
    free = with_own_noise(solve(tracks, held.unknowns, noise))
    (best, added), theirs = _selected(free), np.zeros(len(tracks.first), bool)
    if np.mean(_outliers(best)[tracks.track]) > MIN_SECOND_MOTION_SHARE:
        theirs = second_motion(free, _outliers(free))
    if theirs.any():
        free = with_own_noise(solve(*free.part(~theirs)))
        best, added = _selected(free)
    rival = float(np.mean(theirs[tracks.track]))
    return Explanation(best, added, float(np.mean(free.weight[:, 0] > MIN_INLIER_WEIGHT)) * (1.0 - rival), rival)


def _selected(fit: Fit) -> tuple[Fit, Alternative | None]:
    around = scores(fit)
    chance = lambda one: float(chdtri(one.columns.shape[1], SIGNIFICANCE))
    one = max(TABLE, key=lambda one: around.gain(one.columns) / around.as_one - chance(one))
    # Before the solution, as if all observations were independent: a linear step is not exact enough for more.
    if around.gain(one.columns) < chance(one):
        return fit, None
    tried = solve(fit.tracks, fit.unknowns, fit.noise, one.columns)
    estimate, covariance = np.linalg.pinv(one.columns) @ tried.unknowns.theta, scores(tried).covariance(one.columns)
    if estimate @ np.linalg.pinv(covariance, hermitian=True) @ estimate <= chance(one):
        return fit, None
    return with_own_noise(tried), replace(one, estimate=estimate, covariance=covariance)


def _outliers(fit: Fit) -> np.ndarray:
    return fit.tracks.sums(fit.weight[:, 0] - MIN_INLIER_WEIGHT) < 0.0


def second_motion(fit: Fit, outliers: np.ndarray) -> np.ndarray:
    """Return which of the tracks that contradict the first motion one other motion explains, bool [t], if any."""
    # Without depth, which may be that of either motion.
    own = replace(fit.tracks, depth=np.full(len(fit.tracks.depth), np.nan)).subset(outliers)
    still = np.tile(own.poses[:1], (len(own.poses), 1, 1))
    wide = Noise(WIDE * fit.noise.pixel, WIDE * fit.noise.depth)
    fits = []
    for start in (replace(own, poses=still), own):
        near = solve(start, start_of(start), wide, steps=FIRST_STEPS)
        fits.append(solve(start, near.unknowns, fit.noise))
    other = max(fits, key=lambda one: float(one.weight[:, 0].sum()))
    theirs = np.zeros(len(outliers), bool)
    theirs[np.flatnonzero(outliers)[~_outliers(other)]] = True
    confirmed = np.mean(theirs[fit.tracks.track]) >= MIN_SECOND_MOTION_SHARE and _predicts(other)
    return theirs & confirmed


def _predicts(motion: Fit) -> bool:
    # Free poses fit few tracks in any case: the motion of one half of them must explain most of the other half.
    even = np.arange(len(motion.tracks.first)) % 2 == 0
    first = solve(*motion.part(even))
    tracks, start, noise = motion.part(~even)
    second = solve(tracks, replace(start, poses=first.unknowns.poses), noise, poses_free=False)
    return float(np.mean(_outliers(second))) < thresholds.MAX_UNPREDICTED


def with_own_noise(fit: Fit) -> Fit:
    """Repeat a fit of free poses with the noise that its residuals show."""
    tracks, residual, count = fit.tracks, fit.residual, 2 * len(fit.tracks.frame)
    freedom = max(count - 3 * len(tracks.first) - 6 * len(tracks.rows), 0.15 * count)
    pixel = fit.noise.pixel * sigma_by_median(residual[:, :2]) * np.sqrt(count / freedom)
    known = np.isfinite(tracks.depth)
    shared = residual[known, 2] * np.sqrt(tracks.depths[known])  # the error of a depth is common to its track
    depth = fit.noise.depth * (sigma_by_median(shared) if known.any() else 1.0)
    noise = Noise(max(float(pixel), thresholds.MIN_PIXEL_NOISE), max(depth, thresholds.MIN_RELATIVE_DEPTH_NOISE))
    return solve(tracks, fit.unknowns, noise, fit.columns)


def preferred(fit: Fit) -> bool:
    """Return whether the tracks prefer a fit with free poses to the claim, beyond chance, its unknowns paid for."""
    claim = solve(fit.tracks, start_of(fit.tracks), fit.noise, poses_free=False)
    gain = fit.tracks.sums(claim.loss - fit.loss)
    unknowns = 6 * (len(fit.tracks.rows) - 1) + fit.columns.shape[1]
    return bool(gain.sum() - unknowns > -ndtri(SIGNIFICANCE) * np.sqrt(len(gain)) * gain.std())


def scores(fit: Fit) -> ClusteredScore:
    """Return the score of the whole calibration at a fit, whatever was free there, with poses and points eliminated."""
    tracks, reduced, width = fit.tracks, reduce(fit, EACH, True, 0.0), 6 * len(fit.tracks.rows)
    poses = np.zeros((width, SIZE))
    poses[6:] = -np.linalg.solve(reduced.matrix[6:width, 6:width], reduced.matrix[6:width, width:])
    points = -np.swapaxes(reduced.inverse, 1, 2) @ (reduced.coupling @ np.vstack([poses, EACH]))
    along = fit.by_theta + fit.by_point @ points[tracks.track]
    along += fit.by_pose @ poses.reshape(-1, 6, SIZE)[tracks.frame]
    weighted = along * fit.weight[:, :, None]
    each = -(np.swapaxes(weighted, 1, 2) @ fit.residual[:, :, None])[:, :, 0]
    # Second derivative of Cauchy's kernel over its weight: what the weights alone overstate of the information.
    square = np.sum(weighted * along, 2)
    curved = np.sum(square * (2.0 * fit.weight - 1.0)) / max(float(np.sum(square)), 1e-300)
    information = np.tensordot(weighted, along, ((0, 1), (0, 1)))
    clustered = two_way_clustered(each, tracks.track, tracks.frame) / max(float(curved), 0.3) ** 2
    return ClusteredScore(each.sum(0), information, clustered)
