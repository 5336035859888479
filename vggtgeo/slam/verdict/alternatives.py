"""The explanations that the verdict knows, and which of them the corners of a window prefer.

Each alternative is the run's claim with a few more free parameters. All have free poses, so that a wrong camera cannot
hide behind poses that make up for it; they differ by what else is free (`TABLE`). The one of which a single linear step
promises most (Rao's score test) is solved, and taken if it is significant with robust covariances (`noise.py`). Corners
that another motion explains are set apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from vggtgeo.slam.verdict.corner_adjustment import (
    CENTRE,
    DRIFT,
    FOCAL,
    OFFSET,
    RADIAL,
    READOUT,
    SIZE,
    Fit,
    Noise,
    Tracks,
    solve,
    start_of,
)
from vggtgeo.slam.verdict.noise import scores, with_own_noise
from vggtgeo.slam.verdict.thresholds import MAX_UNPREDICTED, MIN_INLIER_WEIGHT, MIN_SECOND_MOTION_SHARE, SIGNIFICANCE

WIDE = 20.0
"""Times the noise in the first steps towards a second motion, which begin far from it."""
FIRST_STEPS = 6
"""With that noise."""
START = Noise(0.6, 0.03)
"""Pixels of an image of 320, relative: until residuals say more."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """One hypothesis.

    columns: float64 [SIZE, k], directions of `theta` that it frees. factor, unit: the estimate times `factor` is in
    `unit`, for messages. needs_depth: only tried with measured depth.
    """

    name: str
    columns: np.ndarray
    factor: float
    unit: str
    needs_depth: bool = False


def _free(place: slice | int) -> np.ndarray:
    return np.atleast_2d(np.eye(SIZE)[place]).T


TABLE = (
    Alternative("focal length", _free(FOCAL).sum(1, keepdims=True), 100, "%"),
    Alternative("focal length", _free(FOCAL), 100, "% (at four moments)"),
    Alternative("principal point", _free(CENTRE), 100, "% of the focal length (right, down)"),
    Alternative("distortion", _free(RADIAL), 1, "(k1)"),
    Alternative("rolling shutter", _free(READOUT), 1000, "ms"),
    Alternative("depth", _free(DRIFT)[:, 1:], 100, "% (later against the first moment)", needs_depth=True),
    Alternative("depth", _free(OFFSET), 100, "cm", needs_depth=True),
)
"""A focal length that is wrong, or changes; a factor of the depth that changes, or an offset. With poses alone and a
second motion these are seven explanations."""


@dataclass(frozen=True, eq=False)
class Added:
    """An alternative in an explanation. estimate: float64 [k], of its columns; covariance: [k, k]."""

    alternative: Alternative
    estimate: np.ndarray
    covariance: np.ndarray

    @property
    def significant(self) -> bool:
        """Whether the estimate is significant by its robust covariance (Wald)."""
        wald = float(self.estimate @ np.linalg.pinv(self.covariance, hermitian=True) @ self.estimate)
        return wald > float(chi2.isf(SIGNIFICANCE, len(self.estimate)))


@dataclass(frozen=True, eq=False)
class Explanation:
    """What the corners of a window prefer.

    best: fit with free poses and what was added, without the corners of the second motion. added: None where no
    alternative is significant. share, rival: of the observations, explained by the first motion and by the second.
    """

    best: Fit
    added: Added | None
    share: float
    rival: float

    @property
    def tracks(self) -> Tracks:
        """The tracks that the first motion explains."""
        return self.best.tracks


def explain(tracks: Tracks) -> Explanation:
    """Return the preferred explanation of the tracks of a window."""
    noise = Noise(START.pixel * max(tracks.size) / 320.0, START.depth)
    held = solve(tracks, start_of(tracks), noise, poses_free=False, iterations=4)
    free = with_own_noise(solve(tracks, held.unknowns, noise))
    best, added = _selected(free)
    rival = 0.0
    if np.mean(_outliers(best)[tracks.track]) > MIN_SECOND_MOTION_SHARE:
        theirs = second_motion(free, _outliers(free))
        if theirs.any():
            rival = float(np.mean(theirs[tracks.track]))
            free = with_own_noise(solve(*free.part(~theirs)))
            best, added = _selected(free)
    return Explanation(best, added, float(np.mean(free.linear.weight[:, 0] > MIN_INLIER_WEIGHT)) * (1.0 - rival), rival)


def _selected(fit: Fit) -> tuple[Fit, Added | None]:
    """Return the fit with the significant alternative, and that alternative; else the same fit and None."""
    around = scores(fit)
    chance = lambda one: float(chi2.isf(SIGNIFICANCE, one.columns.shape[1]))
    known = [one for one in TABLE if fit.tracks.with_depth or not one.needs_depth]
    one = max(known, key=lambda one: around.gain(one.columns) / around.as_one - chance(one))
    # Before the solution, as if all observations were independent: a linear step is not exact enough for more.
    if around.gain(one.columns) < chance(one):
        return fit, None
    tried = solve(fit.tracks, fit.unknowns, fit.noise, one.columns)
    estimate = np.linalg.pinv(one.columns) @ tried.unknowns.theta
    added = Added(one, estimate, scores(tried).covariance(one.columns))
    return (with_own_noise(tried), added) if added.significant else (fit, None)


def _outliers(fit: Fit) -> np.ndarray:
    """Return the tracks that a fit does not explain, bool [t]."""
    sums = fit.tracks.sums(np.column_stack([fit.linear.weight[:, 0], np.ones(len(fit.tracks.frame))]))
    return np.asarray(sums[:, 0] < MIN_INLIER_WEIGHT * sums[:, 1])


def second_motion(fit: Fit, outliers: np.ndarray) -> np.ndarray:
    """Return the tracks, bool [t], of those that contradict the first motion, that one other motion explains.

    All false if there is no such motion. Depth is ignored: it may be that of either motion.
    """
    own = replace(fit.tracks, depth=np.full(len(fit.tracks.depth), np.nan)).subset(outliers)
    still = np.tile(own.poses[:1], (len(own.poses), 1, 1))
    starts = (replace(own, poses=poses) for poses in (still, own.poses))
    fits = (_fit_from_afar(start, fit.noise) for start in starts)
    other = max(fits, key=lambda one: float(one.linear.weight[:, 0].sum()))
    theirs = np.zeros(len(outliers), bool)
    theirs[np.flatnonzero(outliers)[~_outliers(other)]] = True
    confirmed = np.mean(theirs[fit.tracks.track]) >= MIN_SECOND_MOTION_SHARE and _predicts(other)
    return theirs if confirmed else np.zeros(len(outliers), bool)


def _fit_from_afar(tracks: Tracks, noise: Noise) -> Fit:
    wide = Noise(WIDE * noise.pixel, WIDE * noise.depth)
    return solve(tracks, solve(tracks, start_of(tracks), wide, iterations=FIRST_STEPS).unknowns, noise)


def _predicts(motion: Fit) -> bool:
    """Return whether the motion, fitted to one half of the tracks, explains most of the other half.

    Free poses fit few tracks in any case.
    """
    half = np.arange(len(motion.tracks.first)) % 2 == 0
    first = solve(*motion.part(half))
    tracks, start, noise = motion.part(~half)
    second = solve(tracks, replace(start, poses=first.unknowns.poses), noise, poses_free=False)
    return float(np.mean(_outliers(second))) < MAX_UNPREDICTED
