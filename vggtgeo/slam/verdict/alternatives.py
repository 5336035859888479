"""The explanations that the verdict knows, and which of them the corners of a window prefer.

Each alternative is the run's claim with a few more free parameters. All have free poses, so that a wrong camera cannot
hide behind poses that make up for it; they differ by what else is free (`TABLE`). They are added one after another
(forward selection) as long as one is significant with robust covariances (`noise.py`): what explains most is first.
Before that, without depth, the reversed motion is tried, and corners that another motion explains are set apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.adjustment import (
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
    Unknowns,
    solve,
    start_of,
    subset,
)
from vggtgeo.slam.verdict.levels import LEVEL, LIKELIER, MIN_SHARE
from vggtgeo.slam.verdict.noise import Scores, estimated, scores

MAX_ADDED = 3
"""Alternatives in one explanation."""
MAX_TRIED = 3
"""Alternatives that are solved in each round: those of the largest predicted gain."""
WIDE = 20.0
"""Times the noise in the first steps towards a second motion, which begin far from it."""
FIRST_STEPS = 6
"""With that noise."""
START = Noise(0.6, 0.03)
"""Pixels of an image of 320, relative: until residuals say more."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """A name, and which combinations of the calibration it frees: float64 [SIZE, k]. Two of one name are of a kind."""

    name: str
    columns: np.ndarray
    needs_depth: bool = False


def _rows(*places: slice | int) -> np.ndarray:
    return np.concatenate([np.atleast_2d(np.eye(SIZE)[place]) for place in places]).T


TABLE = (
    Alternative("focal length", _rows(FOCAL).sum(1, keepdims=True)),
    Alternative("focal length", _rows(FOCAL)),
    Alternative("principal point", _rows(CENTRE)),
    Alternative("distortion", _rows(RADIAL)),
    Alternative("rolling shutter", _rows(READOUT)),
    Alternative("depth", _rows(DRIFT)[:, 1:], needs_depth=True),
    Alternative("depth", _rows(OFFSET), needs_depth=True),
)
"""A focal length that is wrong, or changes; a factor of the depth that changes, or an offset. With poses alone, a
second motion and the reversal these are eight explanations."""


@dataclass(frozen=True, eq=False)
class Added:
    """An alternative in an explanation. estimate: float64 [k], of its columns; covariance [k, k]. gain: decrease of
    minus twice the log likelihood. as_one: observations that count as one.
    """

    name: str
    estimate: np.ndarray
    covariance: np.ndarray
    gain: float
    as_one: float


@dataclass(frozen=True, eq=False)
class Explanation:
    """What the corners of a window prefer.

    tracks, noise: that the rest refers to, without the corners of the second motion. free: fit with free
    poses. best: with all that was added. added: in the order in which they were. share, rival: of
    the observations, explained by the first motion and by the second. second: that motion, None where there is none.
    reversal: by how much the reversed motion is likelier than the claimed one, minus twice the log of it, with as many
    observations as count as one; NaN where measured depth excludes it.
    """

    tracks: Tracks
    noise: Noise
    free: Fit
    best: Fit
    added: tuple[Added, ...]
    as_one: float
    share: float
    rival: float
    second: np.ndarray | None
    reversal: float = np.nan

    @property
    def depth_noise(self) -> float:
        """Relative noise of the depth in the middle of the scene."""
        return float(self.noise.of_depth(np.nanmedian(self.tracks.depth, keepdims=True))[0])

    @property
    def reversed(self) -> bool:
        """Whether the reversed motion is preferred."""
        return self.reversal > LIKELIER


def explain(tracks: Tracks) -> Explanation:
    """The preferred explanation of the tracks of a window."""
    noise = Noise(START.pixel * max(tracks.size) / 320.0, START.depth)
    fit = solve(tracks, solve(tracks, start_of(tracks), noise, poses_free=False, iterations=4).unknowns, noise)
    noise = estimated(tracks, fit, noise)
    fit = solve(tracks, fit.unknowns, noise)
    if np.isfinite(tracks.depth).any():
        return _with_the_rest(tracks, noise, fit)
    other = _fit_from(tracks, reversed_poses(fit.unknowns.poses, tracks), noise)
    likelier, rival, sign = (other, fit, 1.0) if other.energy < fit.energy else (fit, other, -1.0)
    noise = estimated(tracks, likelier, noise)
    likelier, rival = (solve(tracks, one.unknowns, noise) for one in (likelier, rival))
    gain = sign * (rival.energy - likelier.energy) / scores(tracks, likelier, noise).as_one
    found = _with_the_rest(tracks, noise, likelier if gain > LIKELIER or sign < 0 else rival)
    return replace(found, reversal=gain)


def _with_the_rest(tracks: Tracks, noise: Noise, fit: Fit) -> Explanation:
    """The explanation of a motion, a second one, and what else is added."""
    chosen = _selected(tracks, noise, fit)
    rival, second = 0.0, None
    outliers = _outliers(tracks, chosen.fit)
    if np.mean(outliers[tracks.track]) > MIN_SHARE:
        outliers = _outliers(tracks, fit)
        rival, second, theirs = second_motion(tracks, noise, outliers)
        if second is not None:
            tracks, kept = subset(tracks, ~theirs)
            fit = solve(tracks, replace(fit.unknowns, points=fit.unknowns.points[kept]), noise)
            noise = estimated(tracks, fit, noise)
            fit = solve(tracks, fit.unknowns, noise)
            chosen = _selected(tracks, noise, fit)
    share = float(np.mean(fit.linear.weight[:, 0] > 0.5)) * (1.0 - rival)
    return Explanation(tracks, chosen.noise, fit, chosen.fit, chosen.added, chosen.as_one, share, rival, second)


@dataclass(frozen=True, eq=False)
class _Selected:
    """The fit with all that is significant, what that is, how many observations count as one, and the noise."""

    fit: Fit
    added: tuple[Added, ...]
    as_one: float
    noise: Noise


def _selected(tracks: Tracks, noise: Noise, fit: Fit) -> _Selected:
    metric = bool(np.isfinite(tracks.depth).any())
    left = [one for one in TABLE if metric or not one.needs_depth]
    added: list[Added] = []
    columns = np.zeros((SIZE, 0))
    while True:
        around = scores(tracks, fit, noise)
        found = []
        for one in _promising(around, columns, left) if len(added) < MAX_ADDED else ():
            union = _basis(np.hstack([columns, one.columns]))
            tried = solve(tracks, fit.unknowns, noise, union)
            gain = fit.energy - tried.energy
            estimate, covariance, as_one = _estimate(tracks, tried, noise, one, union)
            if _significant(estimate, covariance) and gain > 0:
                beyond = gain / around.as_one - float(chi2.isf(LEVEL, len(estimate)))
                found.append((beyond, one, union, tried, Added(one.name, estimate, covariance, gain, as_one)))
        if not found:
            return _Selected(fit, tuple(added), around.as_one, noise)
        _, one, columns, fit, what = max(found, key=lambda each: each[0])
        left.remove(one)
        added.append(what)
        noise = estimated(tracks, fit, noise)
        fit = solve(tracks, fit.unknowns, noise, columns)


def _estimate(
    tracks: Tracks, fit: Fit, noise: Noise, one: Alternative, union: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Of an alternative's columns, the covariance, and how many observations count as one."""
    _, covariance, as_one = scores(tracks, fit, noise).step(union)
    into = np.linalg.pinv(one.columns) @ union
    return np.linalg.pinv(one.columns) @ fit.unknowns.theta, into @ covariance @ into.T, as_one


def _significant(estimate: np.ndarray, covariance: np.ndarray) -> bool:
    wald = float(estimate @ np.linalg.pinv(covariance, hermitian=True) @ estimate)
    return wald > float(chi2.isf(LEVEL, len(estimate)))


def _promising(around: Scores, columns: np.ndarray, left: list[Alternative]) -> list[Alternative]:
    """Those of the largest gain that one linear step predicts (Rao's score), if independent observations made it
    significant: a linear step tells too little of the clusters to be exact here.
    """
    gains = []
    for one in left:
        union = _basis(np.hstack([columns, one.columns]))
        gain = float(around.step(union)[0] @ (union.T @ around.side))
        if union.shape[1] > columns.shape[1] and gain > float(chi2.isf(LEVEL, one.columns.shape[1])):
            gains.append((gain, one))
    return [one for _, one in sorted(gains, key=lambda each: -each[0])[:MAX_TRIED]]


def _basis(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the span, float64 [SIZE, rank]."""
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, values > 1e-9])


def _outliers(tracks: Tracks, fit: Fit) -> np.ndarray:
    """Tracks that a fit does not explain, bool [t]."""
    views = np.add.reduceat(np.ones(len(tracks.frame)), tracks.first)
    return np.asarray(np.add.reduceat(fit.linear.weight[:, 0], tracks.first) / views < 0.5)


def second_motion(tracks: Tracks, noise: Noise, outliers: np.ndarray) -> tuple[float, np.ndarray | None, np.ndarray]:
    """Whether one other motion explains the corners that contradict the first: its share of all observations, its
    poses (None where there is none), and its tracks, bool [t]. Depth has no say: it may be that of either.
    """
    own, _ = subset(replace(tracks, depth=np.full(len(tracks.depth), np.nan)), outliers)
    still = np.tile(tracks.poses[:1], (len(tracks.poses), 1, 1))
    fits = (_fit_from(own, poses, noise) for poses in (still, tracks.poses))
    other = max(fits, key=lambda one: float(one.linear.weight[:, 0].sum()))
    explained = ~_outliers(own, other)
    theirs = np.zeros(len(tracks.first), bool)
    theirs[np.flatnonzero(outliers)[explained]] = True
    share = float(np.mean(theirs[tracks.track]))
    none = 0.0, None, np.zeros(len(tracks.first), bool)
    if share < MIN_SHARE or not _predicts(own, other, noise):
        return none
    return share, other.unknowns.poses, theirs


def _predicts(tracks: Tracks, motion: Fit, noise: Noise) -> bool:
    """Whether the motion, fitted to one half of the tracks, explains most of the other: few tracks have free poses that
    fit them, whatever they do.
    """
    half = np.arange(len(tracks.first)) % 2 == 0
    first, kept = subset(tracks, half)
    fit = solve(first, replace(motion.unknowns, points=motion.unknowns.points[kept]), noise)
    second, kept = subset(tracks, ~half)
    start = replace(fit.unknowns, points=motion.unknowns.points[kept])
    predicted = solve(second, start, noise, poses_free=False)
    return float(np.mean(~_outliers(second, predicted))) > 0.5


def reversed_poses(poses: np.ndarray, tracks: Tracks) -> np.ndarray:
    """Poses [f, 4, 4] that show nearly the same with near and far exchanged.

    The steps across the view change their sign, and turns make up for it at the scene's distance `d`: with a step `t`
    since the first frame the turn is `2 / d e_z x t` more, and an inverse depth `1/z` becomes `2/d - 1/z`. Images tell
    the two apart by what is of second order in the angle of view (Koenderink and van Doorn, 1991).
    """
    since = poses @ rigid.invert(poses[0])
    inverse = float(np.median(np.exp(start_of(replace(tracks, poses=poses)).points[:, 2])))
    moved = since.copy()
    across = since[:, :3, 3] * [1.0, 1.0, 0.0]
    turns = Rotation.from_rotvec(2.0 * inverse * np.cross([0.0, 0.0, 1.0], across)).as_matrix()
    moved[:, :3, :3] = turns @ since[:, :3, :3]
    moved[:, :3, 3] = since[:, :3, 3] - 2.0 * across
    return np.asarray(moved @ poses[0])


def _fit_from(tracks: Tracks, poses: np.ndarray, noise: Noise) -> Fit:
    """The fit with free poses that is begun far from it, at these."""
    points = _in_chart(tracks, start_of(replace(tracks, poses=poses)), poses)
    wide = Noise(WIDE * noise.pixel, WIDE * noise.depth)
    near = solve(tracks, Unknowns(poses, points, np.zeros(SIZE)), wide, iterations=FIRST_STEPS)
    return solve(tracks, near.unknowns, noise)


def _in_chart(tracks: Tracks, start: Unknowns, poses: np.ndarray) -> np.ndarray:
    """Points of a start with other poses, in the chart of the claimed ones."""
    a, b, log_inverse = start.points.T
    local = np.column_stack([a, b, np.ones(len(a))]) * np.exp(-log_inverse)[:, None]
    back, claimed = poses[tracks.anchor], tracks.poses[tracks.anchor]
    relative = claimed @ rigid.invert(back)
    moved = np.einsum("tij,tj->ti", relative[:, :3, :3], local) + relative[:, :3, 3]
    z = np.maximum(moved[:, 2], 1e-3)
    return np.column_stack([moved[:, 0] / z, moved[:, 1] / z, -np.log(z)])
