"""How far the motion that the corners prefer is from that of the run: of a window, and of windows in a chain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.adjustment import solve, start_of, subset
from vggtgeo.slam.verdict.alternatives import Explanation

MIN_OVERLAP = 4
"""Frames that two windows share, if one goes on where the other ends."""


@dataclass(frozen=True)
class Consequence:
    """How far a motion is from the claim, RMS over frames, and the standard deviations of the same.

    places: after alignment, in the unit of the map. turn: from frame to frame, rad.
    """

    places: float
    places_sigma: float
    turn: float
    turn_sigma: float


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses, world -> camera, float64 [f, 4, 4], of rows [f] of the run, and those that it claims there."""

    rows: np.ndarray
    poses: np.ndarray
    claimed: np.ndarray

    def differences(self, free_scale: bool) -> tuple[np.ndarray, np.ndarray]:
        """From the claim: of the places after alignment [f, 3], of the turns from frame to frame, rad [f - 1, 3]."""
        places, theirs = rigid.invert(self.poses)[:, :3, 3], rigid.invert(self.claimed)[:, :3, 3]
        fitted = umeyama(places, theirs, free_scale)
        step = lambda poses: poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)
        turns = Rotation.from_matrix(step(self.poses) @ np.swapaxes(step(self.claimed), 1, 2)).as_rotvec()
        return fitted.scale * places @ fitted.rotation.T + fitted.translation - theirs, np.asarray(turns)

    def difference(self, free_scale: bool) -> tuple[float, float]:
        """Of places and turns, RMS, noise included."""
        places, turn = (float(np.sqrt(np.mean(np.sum(one**2, 1)))) for one in self.differences(free_scale))
        return places, turn


def preferred(explanation: Explanation) -> Motion:
    """The motion of the preferred explanation of a window."""
    tracks = explanation.tracks
    return Motion(tracks.rows, explanation.best.unknowns.poses, tracks.poses)


def halves(explanation: Explanation) -> tuple[Motion, Motion]:
    """The motions that two halves of the tracks prefer, each fitted by itself.

    From the claimed poses, so that both do not begin at one wrong minimum; a reversal is one that must be begun at.
    """
    tracks, best = explanation.tracks, explanation.best
    found = []
    for half in (0, 1):
        some, kept = subset(tracks, np.arange(len(tracks.first)) % 2 == half)
        start = replace(start_of(some), theta=best.unknowns.theta)
        if explanation.reversed:
            start = replace(best.unknowns, points=best.unknowns.points[kept])
        fit = solve(some, start, explanation.noise, best.columns)
        found.append(Motion(tracks.rows, fit.unknowns.poses, tracks.poses))
    return found[0], found[1]


def consequence(first: Motion, second: Motion, free_scale: bool) -> Consequence:
    """What two halves of the tracks confirm.

    Errors of tracks, mistracked corners among them, are independent between the halves: the mean product of what both
    differ from the claim by is free of their noise, and half of what they differ from each other by is the standard
    deviation of their mean.
    """
    values = []
    for one, other in zip(first.differences(free_scale), second.differences(free_scale), strict=True):
        values.append(np.sqrt(max(float(np.mean(np.sum(one * other, 1))), 0.0)))
        values.append(0.5 * np.sqrt(float(np.mean(np.sum((one - other) ** 2, 1)))))
    return Consequence(*map(float, values))


def chains(explanations: Sequence[Explanation]) -> Iterator[list[Explanation]]:
    """Windows that go on where the one before ends."""
    chain = list(explanations[:1])
    for before, after in pairwise(explanations):
        if len(np.intersect1d(before.tracks.rows, after.tracks.rows)) < MIN_OVERLAP:
            yield chain
            chain = []
        chain.append(after)
    if chain:
        yield chain


def chained(motions: Sequence[Motion], free_scale: bool) -> Motion:
    """One motion of windows in a chain: each is brought onto those before by the frames that both have."""
    rows, poses, claimed = motions[0].rows, motions[0].poses, motions[0].claimed
    for motion in motions[1:]:
        _, here, there = np.intersect1d(rows, motion.rows, return_indices=True)
        moved = _onto(motion.poses, motion.poses[there], poses[here], free_scale)
        new = motion.rows > rows[-1]
        rows, poses = np.r_[rows, motion.rows[new]], np.concatenate([poses, moved[new]])
        claimed = np.concatenate([claimed, motion.claimed[new]])
    return Motion(rows, poses, claimed)


def _onto(poses: np.ndarray, own: np.ndarray, theirs: np.ndarray, free_scale: bool) -> np.ndarray:
    """Poses in the world in which those that are called `own` here are `theirs`.

    The turn is the mean of the frames': few places, often on a line, would not determine it.
    """
    turn = Rotation.from_matrix(np.swapaxes(theirs[:, :3, :3], 1, 2) @ own[:, :3, :3]).mean().as_matrix()
    there, here = rigid.invert(theirs)[:, :3, 3], rigid.invert(own)[:, :3, 3] @ turn.T
    around, about = there - there.mean(0), here - here.mean(0)
    scale = np.sqrt(np.sum(around**2) / max(np.sum(about**2), 1e-18)) if free_scale else 1.0
    places = scale * (rigid.invert(poses)[:, :3, 3] @ turn.T - here.mean(0)) + there.mean(0)
    moved = poses.copy()
    moved[:, :3, :3] = poses[:, :3, :3] @ turn.T
    moved[:, :3, 3] = -np.einsum("fij,fj->fi", moved[:, :3, :3], places)
    return moved
