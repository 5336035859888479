"""Without measured depth: does the lens stay what it is, from keyframe to keyframe?

A map that was built with one focal length takes a zoom up by its depths and motions, and ends with residuals that look
like any others: building-walk without depth, enlarged by 1.3 over 40 frames, was 9 cm off and called good. So each
stretch of keyframes is adjusted once more to its matches, with a focal length for each keyframe.

Unknowns: pose (left tangent, translation first) and log factor on the focal lengths of each keyframe, log inverse depth
of each key point in its host. Gauss-Newton with Cauchy weights, damped where a step does not serve; the depths are
eliminated (Schur). First pose held; the unit of length is held by little (`UNIT_HELD`).

With measured depth `sensor_drift.py` says more.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.camera.rolling_shutter import pair_at_once
from vggtgeo.slam.global_map.frame_motions import camera_motions
from vggtgeo.slam.global_map.pose_uncertainty import SHARED_ERRORS
from vggtgeo.slam.sparse_map.covisibility import directions
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.finding import Finding

MOST_ZOOM = 0.065
"""Difference of the logarithms of two focal lengths of a stretch. Of 22 pieces of 60 and 80 frames of three clips as
they are (`benchmarks/starts.py`) 19 have at most 0.025, three of building-walk 0.041 to 0.049, two of these across
white walls and a turn; the first 40 frames of corridor-office 0.045. A focus that breathes
(`benchmarks/edited_videos.py --frames 60`, and the same from other frames) by 2 % either way has at most 0.043, and
costs 1 to 4 cm more; by 5 %, 0.08 to 0.10 and 5 to 11 cm, but 0.05 in 8 keyframes of redkitchen. A zoom to 1.3
(`benchmarks/sensor_drift.py`) has 0.12 to 0.21, and costs 2 to 14 cm."""
SIGMAS = 5.0
KNOWN = 0.02
"""Standard deviation of a log focal length beyond which that keyframe says nothing."""
STRETCH = 40
"""Keyframes that are asked together; half of them are in the next stretch, too."""
SHORT_STRETCH, MOST_SHORT = 12, 4
"""The same where a whole map is asked something that one part of it can answer, and stretches at most."""
LEAST_KEYFRAMES = 4
MOST_MATCHES = 12_000
"""Of a stretch, evenly thinned: more cost time and say no more."""
LEAST_MATCHES = 15
"""Of a keyframe, for one focal length and six of the pose."""
ROBUST = 2.0
"""Pixels: the width of Cauchy's weights."""
PRIOR = 0.3
"""Standard deviation of a log focal length that nothing is known of."""
HELD = 1e-2
"""Information on the logarithm of a depth, so that one that nothing determines stays."""
ITERATIONS, SETTLED = 10, 0.002
"""At most; and the step of a log focal length below which there are no more, a fortieth of what is told."""
LONGEST_DEPTH_STEP = 1.0
UNIT_HELD = 1e-3
"""Information on every step of a keyframe: it holds the unit of length, and a keyframe without a match."""
BEHIND = 1e6
"""Squared pixels that a point behind a camera costs."""


def check_zoom(slam: Slam) -> list[Finding]:
    """A focal length that changes within some stretch of keyframes, the largest change of all."""
    if slam.metric:
        return []
    change, start, end = largest_change(slam)
    if change <= MOST_ZOOM:
        return []
    text = (
        f"the lens zooms: the focal length changes by about {100 * np.expm1(change):.0f} % between frames {start} and "
        f"{end}, and one is assumed for all"
    )
    return [Finding("calibration", "degraded", text, start, end)]


def largest_change(slam: Slam) -> tuple[float, int, int]:
    """Of the logarithm of the focal length within a stretch, as far as it is sure, and the frames between which; zero
    where nothing is.
    """
    found = [(0.0, 0, 0)]
    for stretch in _stretches(slam):
        lenses = focal_lengths(slam, stretch)
        if lenses is not None:
            change, *places = lenses.largest_change()
            start, end = sorted(slam.keyframes[stretch[place]].frame for place in places)
            found.append((change, start, end))
    return max(found)


@dataclass(frozen=True, eq=False)
class FocalLengths:
    """Of keyframes, relative to that of the run, logarithms: float64 [n]; their covariance [n, n]."""

    value: np.ndarray
    covariance: np.ndarray

    def largest_change(self) -> tuple[float, int, int]:
        """The largest difference that is sure, and between which two; zero where none is. The value of each is the
        median of it and its neighbours: a lens moves on, and one keyframe of bad matches does not count.
        """
        variance = np.diag(self.covariance)
        known = np.flatnonzero(variance < KNOWN**2)
        if len(known) < LEAST_KEYFRAMES:
            return 0.0, 0, 0
        own = self.value[known]
        value = np.array([np.median(own[max(place - 1, 0) : place + 2]) for place in range(len(own))])
        apart = np.abs(value[:, None] - value)
        spread = variance[known, None] + variance[known] - 2 * self.covariance[np.ix_(known, known)]
        apart = np.where(apart > SIGMAS * np.sqrt(np.maximum(spread, 0.0)), apart, 0.0)
        first, second = np.unravel_index(np.argmax(apart), apart.shape)
        return float(apart[first, second]), int(known[first]), int(known[second])


def focal_lengths(slam: Slam, stretch: np.ndarray) -> FocalLengths | None:
    """The focal length that each of these keyframes wants, by the matches among them; None where there are too few.

    stretch: int [n], places in `slam.keyframes`.
    """
    seen = matches_among(slam, stretch)
    if seen is None:
        return None
    poses = np.array([slam.keyframes[place].pose for place in stretch], np.float64)
    unknowns = Unknowns(poses, np.zeros(len(stretch)), seen.depth)
    linear, damping = linearise(seen, unknowns), 1e-3
    for _ in range(ITERATIONS):
        step, depth_step = linear.step(damping)
        moved = unknowns.moved(step, depth_step)
        tried = linearise(seen, moved)
        if not tried.cost < linear.cost:
            damping *= 10
            continue
        unknowns, linear, damping = moved, tried, max(damping / 5, 1e-6)
        if np.abs(step[:, 6]).max() < SETTLED:
            break
    return FocalLengths(unknowns.focal, SHARED_ERRORS * linear.noise**2 * linear.focal_covariance())


@dataclass(frozen=True, eq=False)
class Matches:
    """host, target: int [m], keyframes of a stretch; edges: int [e], the first match of each edge; point: int [m], of
    `depth`, log inverse depths [p]; before, after: float64 [m, 2], pixels; intrinsics: of the run.
    """

    host: np.ndarray
    target: np.ndarray
    edges: np.ndarray
    point: np.ndarray
    before: np.ndarray
    after: np.ndarray
    depth: np.ndarray
    intrinsics: np.ndarray


@dataclass(frozen=True, eq=False)
class Unknowns:
    """poses: float64 [n, 4, 4]; focal: [n], log factors; depth: [p], log inverse depths."""

    poses: np.ndarray
    focal: np.ndarray
    depth: np.ndarray

    def moved(self, step: np.ndarray, depth_step: np.ndarray) -> Unknowns:
        """After a step of the keyframes, [n, 7], and of the depths, [p], which is cut where it is long."""
        depth = self.depth + np.clip(depth_step, -LONGEST_DEPTH_STEP, LONGEST_DEPTH_STEP)
        return Unknowns(rigid.moved(self.poses, step[:, :6]), self.focal + step[:, 6], depth)


@dataclass(frozen=True, eq=False)
class Linear:
    """Normal equations: of the keyframes [7n, 7n] and [7n], of the depths [p] and [p], both [p, 7n]; the robust cost;
    noise: standard deviation of a match, pixels.
    """

    frames: np.ndarray
    frames_side: np.ndarray
    depths: np.ndarray
    depths_side: np.ndarray
    both: np.ndarray
    cost: float
    noise: float

    def step(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Of the keyframes [n, 7], and of the depths [p]."""
        depths = self.depths * (1 + damping)
        reduced = self.frames - (self.both.T / depths) @ self.both
        side = self.frames_side - self.both.T @ (self.depths_side / depths)
        reduced[np.diag_indices(len(reduced))] *= 1 + damping
        own = np.zeros(len(side))
        own[6:] = np.linalg.solve(reduced[6:, 6:] + UNIT_HELD * np.eye(len(side) - 6), side[6:])
        return own.reshape(-1, 7), (self.depths_side - self.both @ own) / depths

    def focal_covariance(self) -> np.ndarray:
        """Of the log focal lengths, all else free, for matches of one pixel: float64 [n, n]."""
        reduced = (self.frames - (self.both.T / self.depths) @ self.both)[6:, 6:]
        return np.asarray(np.linalg.inv(reduced + UNIT_HELD * np.eye(len(reduced)))[::7, ::7])


def _stretches(slam: Slam) -> Iterable[np.ndarray]:
    """Places of the keyframes of this run, in stretches that overlap by half."""
    own = _own_keyframes(slam)
    last = max(len(own) - STRETCH, 0)
    starts = np.linspace(0, last, int(np.ceil(last / (STRETCH / 2))) + 1).astype(int)
    return (own[start : start + STRETCH] for start in starts if len(own) >= LEAST_KEYFRAMES)


def short_stretches(slam: Slam) -> list[np.ndarray]:
    """Places of the keyframes of this run, `SHORT_STRETCH` in a row, at most `MOST_SHORT` of them, evenly spread."""
    own = _own_keyframes(slam)
    if len(own) < LEAST_KEYFRAMES:
        return []
    last = max(len(own) - SHORT_STRETCH, 0)
    count = min(int(np.ceil(last / SHORT_STRETCH)) + 1, MOST_SHORT)
    return [own[start : start + SHORT_STRETCH] for start in np.unique(np.linspace(0, last, count).astype(int))]


def _own_keyframes(slam: Slam) -> np.ndarray:
    """Places of those that are not of a known map."""
    return np.array([place for place, keyframe in enumerate(slam.keyframes) if keyframe.recorded is None], int)


def one_focal_length(keyframes: int) -> np.ndarray:
    """What makes the 7 unknowns of each keyframe of 6 of each and one focal length of all: float64 [7n, 6n + 1]."""
    shared = np.zeros((7 * keyframes, 6 * keyframes + 1))
    for row in range(keyframes):
        shared[7 * row : 7 * row + 6, 6 * row : 6 * row + 6] = np.eye(6)
        shared[7 * row + 6, -1] = 1.0
    return shared


def matches_among(slam: Slam, stretch: np.ndarray) -> Matches | None:
    """Key points of known depth in these keyframes, and where others of them saw each."""
    keyframes = slam.keyframes
    place_of = {keyframes[place].number: row for row, place in enumerate(stretch)}
    by_number = {number: keyframes[stretch[row]] for number, row in place_of.items()}
    intrinsics = np.asarray(slam.intrinsics, np.float64)
    motions = None if slam.camera.readout is None else camera_motions(slam, len(keyframes))
    starts = np.cumsum([0, *(len(keyframes[place].points.inverse_depth) for place in stretch)])
    columns = []
    inside = [pair for pair in slam.map.pairs if pair.first in place_of and pair.second in place_of]
    thin = max(1, int(np.ceil(sum(2 * len(pair.points) for pair in inside) / MOST_MATCHES)))
    for pair in inside:
        for edge in directions(pair, by_number):
            host, target = by_number[edge.host], by_number[edge.target]
            inverse = host.points.inverse_depth[edge.slots]
            known = np.flatnonzero(np.isfinite(inverse) & (inverse > 0))[::thin]
            if not len(known):
                continue
            before, after = host.points.pixels[edge.slots[known]], edge.pixels[known]
            ends = place_of[edge.host], place_of[edge.target]
            if motions is not None and slam.camera.readout is not None:
                relative = target.pose @ rigid.invert(host.pose)
                moving = motions[stretch[ends[0]]], motions[stretch[ends[1]]]
                before, after = pair_at_once(
                    *(before, after, 1.0 / inverse[known], relative, moving, intrinsics, host.size, slam.camera.readout)
                )
            slots = starts[ends[0]] + edge.slots[known]
            columns.append((np.tile(ends, (len(known), 1)), slots, before, after, np.log(inverse[known])))
    if not columns:
        return None
    ends_of, slots, before, after, depth = (np.concatenate(column) for column in zip(*columns, strict=True))
    often = np.bincount(ends_of.ravel(), minlength=len(stretch)) >= LEAST_MATCHES
    if np.count_nonzero(often) < LEAST_KEYFRAMES:
        return None
    _, first, point = np.unique(slots, return_index=True, return_inverse=True)
    edges = np.cumsum([0, *(len(column[1]) for column in columns[:-1])])
    return Matches(ends_of[:, 0], ends_of[:, 1], edges, point, before, after, depth[first], intrinsics)


def match_energies(seen: Matches, unknowns: Unknowns) -> np.ndarray:
    """Robust energy of each match, squared pixels, float64 [m]."""
    squared = np.sum(derivatives(seen, unknowns)[0] ** 2, 1)
    return np.asarray(ROBUST**2 * np.log1p(np.where(np.isfinite(squared), squared, BEHIND) / ROBUST**2))


def linearise(seen: Matches, unknowns: Unknowns) -> Linear:
    """The normal equations there."""
    residual, by_frames, by_depth = derivatives(seen, unknowns)
    squared = np.sum(residual**2, 1)
    good = np.isfinite(squared)
    squared = np.where(good, squared, BEHIND)
    weight = good / (1.0 + squared / ROBUST**2)
    cost = ROBUST**2 * float(np.sum(np.log1p(squared / ROBUST**2)))
    residual, by_frames, by_depth = (
        np.where(good.reshape(-1, *([1] * (values.ndim - 1))), values, 0.0)
        for values in (residual, by_frames, by_depth)
    )
    size, points = 7 * len(unknowns.focal), len(unknowns.depth)
    columns = np.concatenate([7 * seen.host[:, None] + np.arange(7), 7 * seen.target[:, None] + np.arange(7)], 1)
    weighted = by_frames * weight[:, None, None]
    frames, frames_side = np.zeros((size, size)), np.zeros(size)
    rows = columns[seen.edges]  # all matches of an edge touch the same two keyframes
    squares = np.add.reduceat(np.swapaxes(weighted, 1, 2) @ by_frames, seen.edges)
    np.add.at(frames, (rows[:, :, None], rows[:, None, :]), squares)
    np.add.at(frames_side, rows, -np.add.reduceat(np.einsum("mij,mi->mj", weighted, residual), seen.edges))
    both = np.zeros((points, size))
    np.add.at(both, (seen.point[:, None], columns), np.einsum("mij,mi->mj", weighted, by_depth))
    total = lambda values: np.bincount(seen.point, weight * np.sum(values, 1), points)
    focal = np.arange(6, size, 7)
    frames[focal, focal] += 1 / PRIOR**2
    frames_side[focal] -= unknowns.focal / PRIOR**2
    cost += float(np.sum(unknowns.focal**2)) / PRIOR**2
    noise = 1.48 * float(np.median(np.abs(residual[good]))) if good.any() else np.inf
    return Linear(frames, frames_side, HELD + total(by_depth**2), -total(by_depth * residual), both, cost, noise)


def derivatives(seen: Matches, unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals float64 [m, 2], NaN behind the camera; derivatives by host and target [m, 2, 14], by depth [m, 2]."""
    centre = seen.intrinsics[2:]
    focal = seen.intrinsics[:2] * np.exp(unknowns.focal)[:, None]
    at = (seen.before - centre) / focal[seen.host]
    rays = np.column_stack([at, np.ones(len(at))])
    relative = unknowns.poses[seen.target] @ rigid.invert(unknowns.poses)[seen.host]
    inverse = np.exp(unknowns.depth[seen.point])
    shift = relative[:, :3, 3] * inverse[:, None]
    turned = lambda local: np.einsum("mij,mj->mi", relative[:, :3, :3], local)
    there = turned(rays) + shift  # times the inverse depth
    there[there[:, 2] <= 0] = np.nan
    own = focal[seen.target]
    rows = np.stack(pinhole.projection_rows(there, (1.0, 1.0, 0.0, 0.0))).transpose(2, 0, 1) * own[:, :, None]
    by_point = rows[:, :, :3]
    by_target = np.concatenate([by_point * inverse[:, None, None], rows[:, :, 3:]], 2)
    by_host = -by_target @ rigid.adjoint(relative)
    off_centre = own * there[:, :2] / there[:, 2:]
    by_host_focal = np.einsum("mij,mj->mi", by_point, turned(np.column_stack([-at, np.zeros(len(at))])))
    by_frames = np.concatenate([by_host, by_host_focal[:, :, None], by_target, off_centre[:, :, None]], 2)
    by_depth = np.einsum("mij,mj->mi", by_point, shift)
    return off_centre + centre - seen.after, by_frames, by_depth
