"""The explanations that the verdict knows, and which of them the corners of a window prefer.

Each alternative is the run's claim with a few more free parameters. All have free poses, so that a wrong camera cannot
hide behind poses that make up for it; they differ by what else is free (`TABLE`). They are added one after another
(forward selection) as long as one is significant with robust covariances (`noise.py`): what explains most is first.
Before that, corners that another motion explains are set apart (`second_motion`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from vggtgeo.evaluation.alignment import umeyama
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
)
from vggtgeo.slam.verdict.noise import Scores, estimated, scores

LEVEL = 1e-6
"""Significance of an alternative. Seven are tried in each window."""
MAX_ADDED = 3
"""Alternatives in one explanation."""
MAX_TRIED = 3
"""Alternatives that are solved in each round: those of the largest predicted gain."""
MIN_SHARE = 0.15
"""Of the observations that must contradict the first motion before a second one is looked for."""
WIDE = 20.0
"""Times the noise in the first steps towards a second motion, which begin far from it."""
START = Noise(0.6, 0.03)
"""Pixels of an image of 320, relative: until residuals say more."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """A name, and which combinations of the calibration it frees: float64 [SIZE, k]."""

    name: str
    columns: np.ndarray
    needs_depth: bool = False


def _rows(*places: slice | int) -> np.ndarray:
    return np.concatenate([np.atleast_2d(np.eye(SIZE)[place]) for place in places]).T


TABLE = (
    Alternative("focal length", _rows(FOCAL).sum(1, keepdims=True)),
    Alternative("zoom", _rows(FOCAL)),
    Alternative("principal point", _rows(CENTRE)),
    Alternative("distortion", _rows(RADIAL)),
    Alternative("rolling shutter", _rows(READOUT)),
    Alternative("depth factor", _rows(DRIFT)[:, 1:], needs_depth=True),
    Alternative("depth offset", _rows(OFFSET), needs_depth=True),
)


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


def explain(tracks: Tracks) -> Explanation:
    """The preferred explanation of the tracks of a window."""
    noise = Noise(START.pixel * max(tracks.size) / 320.0, START.depth)
    start = start_of(tracks)
    fit = solve(tracks, solve(tracks, start, noise, poses_free=False, iterations=4).unknowns, noise)
    noise = estimated(tracks, fit, noise)
    fit = solve(tracks, fit.unknowns, noise)
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


def subset(tracks: Tracks, kept: np.ndarray) -> tuple[Tracks, np.ndarray]:
    """The tracks of which `kept`, bool [t], is true, and their numbers."""
    rows = kept[tracks.track]
    numbers = np.flatnonzero(kept)
    track = (np.cumsum(kept) - 1)[tracks.track[rows]]
    first = np.flatnonzero(np.r_[True, track[1:] != track[:-1]])
    parts = {name: getattr(tracks, name)[rows] for name in ("frame", "pixels", "depth", "readout")}
    return replace(tracks, **parts, track=track, first=first), numbers


def second_motion(tracks: Tracks, noise: Noise, outliers: np.ndarray) -> tuple[float, np.ndarray | None, np.ndarray]:
    """Whether one other motion explains the corners that contradict the first: its share of all observations, its
    poses (None where there is none), and its tracks, bool [t].
    """
    own, _ = subset(tracks, outliers)
    without = replace(own, depth=np.full(len(own.depth), np.nan))
    still = np.tile(tracks.poses[:1], (len(tracks.poses), 1, 1))
    fits = []
    for seen in (own, without) if np.isfinite(own.depth).any() else (without,):
        for poses in (still, tracks.poses):
            points = _in_chart(seen, start_of(replace(seen, poses=poses)), poses)
            wide = solve(seen, Unknowns(poses, points, np.zeros(SIZE)), Noise(WIDE * noise.pixel, WIDE * noise.depth))
            fits.append(solve(seen, wide.unknowns, noise))
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
    first, kept = subset(replace(tracks, depth=np.full(len(tracks.depth), np.nan)), half)
    fit = solve(first, replace(motion.unknowns, points=motion.unknowns.points[kept]), noise)
    second, kept = subset(replace(tracks, depth=np.full(len(tracks.depth), np.nan)), ~half)
    start = replace(fit.unknowns, points=motion.unknowns.points[kept])
    predicted = solve(second, start, noise, poses_free=False)
    return float(np.mean(~_outliers(second, predicted))) > 0.5


def _in_chart(tracks: Tracks, start: Unknowns, poses: np.ndarray) -> np.ndarray:
    """Points of a start with other poses, in the chart of the claimed ones."""
    a, b, log_inverse = start.points.T
    local = np.column_stack([a, b, np.ones(len(a))]) * np.exp(-log_inverse)[:, None]
    back, claimed = poses[tracks.anchor], tracks.poses[tracks.anchor]
    relative = claimed @ rigid.invert(back)
    moved = np.einsum("tij,tj->ti", relative[:, :3, :3], local) + relative[:, :3, 3]
    z = np.maximum(moved[:, 2], 1e-3)
    return np.column_stack([moved[:, 0] / z, moved[:, 1] / z, -np.log(z)])


@dataclass(frozen=True)
class Consequence:
    """How far a motion is from the claim, RMS over frames, and the standard deviations of the same.

    places: after alignment, in the unit of the map. turn: from frame to frame, rad.
    """

    places: float
    places_sigma: float
    turn: float
    turn_sigma: float


def consequence(explanation: Explanation, free_scale: bool) -> Consequence:
    """Of the preferred explanation, as both halves of the tracks confirm it.

    Each half is fitted by itself, from the claimed poses, so that both do not begin at one wrong minimum. Errors of
    tracks, mistracked corners among them, are independent between the halves: the mean product of what both differ from
    the claim by is free of their noise, and half of what they differ from each other by is the standard deviation of
    their mean.
    """
    tracks, best = explanation.tracks, explanation.best
    halves = []
    for half in (0, 1):
        some, _ = subset(tracks, np.arange(len(tracks.first)) % 2 == half)
        start = replace(start_of(some), theta=best.unknowns.theta)
        fit = solve(some, start, explanation.noise, best.columns)
        halves.append(_differences(fit.unknowns.poses, tracks.poses, free_scale))
    values = []
    for first, second in zip(*halves, strict=True):
        values.append(np.sqrt(max(float(np.mean(np.sum(first * second, 1))), 0.0)))
        values.append(0.5 * np.sqrt(float(np.mean(np.sum((first - second) ** 2, 1)))))
    return Consequence(*map(float, values))


def difference(explanation: Explanation, free_scale: bool) -> tuple[float, float]:
    """Places and turns by which the preferred explanation differs from the claim, RMS, noise included."""
    off = _differences(explanation.best.unknowns.poses, explanation.tracks.poses, free_scale)
    places, turn = (float(np.sqrt(np.mean(np.sum(one**2, 1)))) for one in off)
    return places, turn


def _differences(poses: np.ndarray, claimed: np.ndarray, free_scale: bool) -> tuple[np.ndarray, np.ndarray]:
    """Of the places after alignment, float64 [f, 3], and of the turns from frame to frame, rad, [f - 1, 3]."""
    places, theirs = rigid.invert(poses)[:, :3, 3], rigid.invert(claimed)[:, :3, 3]
    fitted = umeyama(places, theirs, free_scale)
    step = lambda poses: poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)
    turns = Rotation.from_matrix(step(poses) @ np.swapaxes(step(claimed), 1, 2)).as_rotvec()
    return fitted.scale * places @ fitted.rotation.T + fitted.translation - theirs, np.asarray(turns)
