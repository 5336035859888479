"""With measured depth: are the lens and the unit of the depth the same in all keyframes?

A phone that zooms, a depth camera that warms up, one that starts again in another mode, recordings that were joined.

A picture that grows because the camera goes forward grows by `t_z / z`, near parts more than far ones; one that grows
because the lens zooms grows everywhere alike. So the matches of two keyframes whose depth was measured say, with their
relative pose free, by what factor the focal length changed in between. And the depth that the first one measured,
carried by the pose of matches and one lens, says by what factor the second one measures longer. Where the lens changes,
that pose is wrong, and nothing is said of the depth.

Each keyframe gets a logarithm of its own, of the focal length and of the unit, by robust least squares over the pairs
that are at most `REACH` keyframes apart: a jump is no outlier to these, and a slow change adds up. The largest
difference between any two keyframes counts that is beyond `MOST_CHANGE` and beyond chance.

What a sensor measures wrongly at a distance, as `z (1 + b z)`, looks like either change, by about `b` for each metre
that the camera goes forward: what lies ahead is measured longer than it is from nearer. So no two keyframes are
compared between which the camera went farther ahead than `MOST_AHEAD`.

Without measured depth nothing is asked here: see `zoom.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.camera.rolling_shutter import pair_at_once
from vggtgeo.slam.global_map.frame_motions import camera_motions
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.window.gauge import NULL

MOST_CHANGE = 0.08
"""Of the logarithm of either factor: what is told of a focal length, or a scale, that is off as a whole. Maps of the
four clips as they are (6 to 161 keyframes) have at most 0.031 of the lens, and where white walls leave it open 0.077,
which is four standard deviations (building-walk); 0.027 of the unit, and redkitchen as a whole 0.058. Noise of 3 % a
metre, holes, depth cut off at 3 m, that of 40 x 30 pixels have at most 0.034. Depth that is 1.15 times as long at the
end of 125 frames of corridor-office has 0.10 (11 cm off), over fifty of them 0.15, 1.2 times from the middle on 0.20
(21 cm); docs/stress.md has a table."""
SIGMAS = 5.0
NOISE = 0.003
"""Standard deviation of the log factor of a pair beyond that of its matches: errors of depth that they share."""
MOST_SIGMA = MOST_CHANGE / SIGMAS
"""Of a logarithm by its own pair: one that knows it worse says nothing. Straight on before a white wall the lens is
left open: in building-walk, frames 43 to 49, by 0.03 to 0.05, and the six values there, -0.12 in their median, were
taken for a zoom."""
WITHIN = 100
"""Keyframes: small errors add up over more."""
WITHIN_NOISE, MOST_NOISE = 20, 0.02
"""The same where the relative noise between two depths of a point is more than that. Noisy depth does not tell near
from far, and a part of what steps forward enlarge looks like a zoom: `noise^2` of the variance of the logarithm of the
depths (0.3^2 in rooms), here 0.4 %, and a hundred keyframes that walk forward enlarge by `exp(10)`. The clips have
0.004 to 0.009."""
REACH = 3
"""Keyframes that a pair is apart at most; a few milliseconds a pair."""
LEAST_PAIRS = 2
"""From one side of a place between keyframes to the other: the matches of one may be those of something that moves."""
MOST_AHEAD = 4.0
"""Metres: near and far within pairs say b = 1.9 % a metre of the Kinect of redkitchen, which was not calibrated, and
0.1 to 0.2 % of the HoloLens clips."""
LEAST_MATCHES = 15
LEAST_FLOW = 3.0
"""Pixels, the median of a pair's matches: a camera that stands still says nothing of its lens."""
HUBER = 1.0
FARTHEST = 20.0
"""Pixels: residuals beyond are mismatches."""
LEAST = 8
"""Matches of a pair that are none of these, if it is to say anything: twice what its seven unknowns need."""
ROBUST = 1.5
"""Standard deviations: Huber's width over pairs."""
ITERATIONS, SETTLED, LONGEST_STEP = 15, 1e-4, 0.1
"""Of the pose and the factor: metres, radians, and shares; a hundredth of what is told."""


def check_sensors(slam: Slam) -> Iterator[Finding]:
    """Whether one lens and one unit of depth hold in all keyframes."""
    said, ahead = statements(slam), way_ahead(slam)
    within = WITHIN if said.noise <= MOST_NOISE else WITHIN_NOISE
    lens = changes(said.focal, ahead, within)
    for first, last, value in lens:
        text = f"the lens zooms: the focal length changes, by a factor of {np.exp(value):.2f}"
        yield from _told(slam, first, last, "calibration", text)
    unit = said.unit.apart_from(lens)
    for first, last, value in changes(unit, ahead, within):
        text = f"the unit of the sensor's depth changes, by a factor of {np.exp(value):.2f}"
        yield from _told(slam, first, last, "depth scale", text)


def _told(slam: Slam, first: int, last: int, check: str, text: str) -> Iterator[Finding]:
    start, end = (slam.keyframes[place].frame for place in (first, last))
    if end >= 0:  # not of a known map, which was judged when it was made
        text = f"frames {max(start, 0)} to {end}: {text}, and one is assumed for all"
        yield Finding(check, "degraded", text, max(start, 0), end, scale=check == "depth scale")


@dataclass(frozen=True, eq=False)
class Ratios:
    """Logarithms of a quantity in the second keyframe of each pair over that in the first, known to `MOST_SIGMA`.

    numbers: int [m, 2], first and second keyframe; value, sigma: float64 [m].
    """

    numbers: np.ndarray
    value: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(cls, numbers: list[tuple[int, int]], said: list[tuple[float, float]]) -> Ratios:
        """Those that are known; said: value and standard deviation of each."""
        value, sigma = np.array(said, np.float64).reshape(-1, 2).T
        known = sigma <= MOST_SIGMA
        return cls(np.array(numbers, int).reshape(-1, 2)[known], value[known], sigma[known])

    def rows(self, which: np.ndarray) -> Ratios:
        """Some of them; which: bool [m]."""
        return Ratios(self.numbers[which], self.value[which], self.sigma[which])

    def among(self, first: int, last: int) -> Ratios:
        """Between keyframes `first` to `last - 1`, counted from `first`."""
        low, high = self.numbers.min(1), self.numbers.max(1)
        inside = self.rows((low >= first) & (high < last))
        return replace(inside, numbers=inside.numbers - first)

    def apart_from(self, spans: list[tuple[int, int, float]]) -> Ratios:
        """Without the pairs that reach into what lies between two places."""
        low, high = self.numbers.min(1), self.numbers.max(1)
        into = [(low < last) & (high > first) for first, last, _ in spans]
        return self.rows(~np.any(into, axis=0)) if into else self


@dataclass(frozen=True, eq=False)
class Statements:
    """What the pairs of a map say of focal length and unit of depth. noise: the median one of their depths, relative; 0
    without any.
    """

    focal: Ratios
    unit: Ratios
    noise: float


def statements(slam: Slam) -> Statements:
    """Of the keyframes that are at most `REACH` apart, both ways."""
    camera = np.asarray(slam.intrinsics, np.float64)
    near = list(directed_pairs(slam, [pair for pair in slam.map.pairs if pair.second - pair.first <= REACH]))
    found = [compare(pair, camera) for pair in near]
    numbers = [pair.numbers for pair in near]
    focal, unit = (Ratios.of(numbers, said) for said in ([f.focal for f in found], [f.depth for f in found]))
    noise = [one.noise for one in found if np.isfinite(one.noise)]
    return Statements(focal, unit, float(np.median(noise)) if noise else 0.0)


def way_ahead(slam: Slam) -> np.ndarray:
    """How far the camera went in the direction it looked, up to each keyframe: float64 [n], metres."""
    poses = np.array([keyframe.pose for keyframe in slam.keyframes], np.float64).reshape(-1, 4, 4)
    return np.append(0.0, -np.cumsum((poses[1:] @ rigid.invert(poses[:-1]))[:, 2, 3]))[: len(poses)]


def changes(ratios: Ratios, ahead: np.ndarray, within: int) -> list[tuple[int, int, float]]:
    """First and last keyframe of each change that is beyond chance, and its logarithm, in order; of those that overlap
    the largest, which goes on as long as it grows by `MOST_CHANGE` in `WITHIN` keyframes.

    ahead: float64 [n], metres of each keyframe's way ahead.
    """
    beyond: list[tuple[int, int, float]] = []
    for start in range(0, max(len(ahead) - within // 2, 1), within // 2):
        own = ahead[start : start + within]
        curve = Curve.of(ratios.among(start, start + len(own)), len(own))
        near = np.abs(own - own[:, None]) < MOST_AHEAD
        beyond += [(start + first, start + last, value) for first, last, value in curve.differences(near)]
    found: list[tuple[int, int, float]] = []
    grown = lambda one: abs(one[2]) - (one[1] - one[0]) * MOST_CHANGE / WITHIN
    for first, last, value in sorted(beyond, key=grown, reverse=True):
        if all(last <= start or first >= end for start, end, _ in found):
            found.append((first, last, value))
    return sorted(found)


@dataclass(frozen=True, eq=False)
class Curve:
    """The logarithm of a quantity in each keyframe, float64 [n], and its covariance [n, n]. part: int [n], the same for
    those whose difference is known.
    """

    value: np.ndarray
    covariance: np.ndarray
    part: np.ndarray

    @classmethod
    def of(cls, ratios: Ratios, keyframes: int) -> Curve:
        """By iteratively reweighted least squares; both directions of a pair have the same matches and count as one.
        Pairs that agree with each other less than they say count as they agree.
        """
        first, second = ratios.numbers.T
        value, information = np.zeros(keyframes), 0.5 / (ratios.sigma**2 + NOISE**2)
        free = np.sqrt(max(1.0 - 2 * keyframes / max(len(first), 1), 0.1))
        weight, normal = information, np.eye(keyframes)
        for _ in range(ITERATIONS):
            normal = _normal(first, second, weight, keyframes)
            side = np.bincount(second, weight * ratios.value, keyframes)
            value = np.linalg.solve(normal, side - np.bincount(first, weight * ratios.value, keyframes))
            off = np.abs(value[second] - value[first] - ratios.value) * np.sqrt(2 * information)
            scale = max(1.48 * float(np.median(off)) / free, 1.0) if len(off) else 1.0
            weight = information / scale**2 * np.minimum(1.0, ROBUST * scale / np.maximum(off, 1e-9))
        part = _parts(ratios.numbers, keyframes)
        return cls(_medians_of_three(value, part), np.linalg.inv(normal), part)

    def differences(self, near: np.ndarray) -> Iterator[tuple[int, int, float]]:
        """The earlier and the later keyframe, and the difference, of those that count; near: bool [n, n], which may."""
        change = self.value - self.value[:, None]
        own = np.diag(self.covariance)
        sigma = np.sqrt(np.maximum(own[:, None] + own - 2 * self.covariance, NOISE**2))
        sure = (np.abs(change) > MOST_CHANGE) & (np.abs(change) > SIGMAS * sigma)
        for first, last in np.argwhere(np.triu(sure & near & (self.part[:, None] == self.part))).tolist():
            yield first, last, float(change[first, last])


def _normal(first: np.ndarray, second: np.ndarray, weight: np.ndarray, keyframes: int) -> np.ndarray:
    """Normal equations of the differences, with a weak prior for keyframes that nothing joins: float64 [n, n]."""
    normal = np.eye(keyframes)
    np.add.at(normal, (np.r_[first, second], np.r_[first, second]), np.r_[weight, weight])
    np.add.at(normal, (np.r_[first, second], np.r_[second, first]), -np.r_[weight, weight])
    return normal


def _parts(numbers: np.ndarray, keyframes: int) -> np.ndarray:
    """Which keyframes too few pairs part from the next ones: int [n], the same within a part."""
    over = np.zeros(max(keyframes - 1, 0), int)
    for first, last in np.unique(np.sort(numbers, axis=1), axis=0):
        over[first:last] += 1
    return np.append(0, np.cumsum(over < LEAST_PAIRS))


def _medians_of_three(value: np.ndarray, part: np.ndarray) -> np.ndarray:
    """With both neighbours of the same part: what changes stays changed, and one bad picture is none."""
    found = np.full(len(value), np.nan)
    for own in (np.flatnonzero(part == number) for number in np.unique(part)):
        if len(own) >= 3:
            middle = np.median(np.lib.stride_tricks.sliding_window_view(value[own], 3), axis=1)
            found[own] = np.r_[middle[0], middle, middle[-1]]
    return found


@dataclass(frozen=True, eq=False)
class DepthPair:
    """What two keyframes share: their numbers, pixels before and after float64 [m, 2], measured depth before and after
    [m] (NaN: none; before: never), their relative pose.
    """

    numbers: tuple[int, int]
    before: np.ndarray
    after: np.ndarray
    depth: np.ndarray
    depth_after: np.ndarray
    relative: np.ndarray


@dataclass(frozen=True, eq=False)
class Factors:
    """Log ratios, second keyframe to first, each with its standard deviation: of focal length, of measured depth.
    noise: standard deviation of the latter in a single match, NaN of few.
    """

    focal: tuple[float, float]
    depth: tuple[float, float]
    noise: float = float("nan")


def compare(pair: DepthPair, intrinsics: np.ndarray) -> Factors:
    """The factors between two keyframes, pose free; intrinsics: fx, fy, cx, cy, taken for both."""
    relative, value = pair.relative, 0.0
    fit = _fit(pair, intrinsics, relative, value)
    for _ in range(ITERATIONS):
        if len(fit.residual) < LEAST or not fit.determined:
            return _NOTHING
        step = -np.linalg.solve(fit.normal, fit.gradient)
        relative = rigid.moved(relative[None], step[None, :6])[0]
        value += float(np.clip(step[6], -LONGEST_STEP, LONGEST_STEP))
        if np.abs(step).max() < SETTLED:
            break
        fit = _fit(pair, intrinsics, relative, value)
    else:
        return _NOTHING
    variance = np.sum(fit.weight * fit.residual**2) / max(fit.residual.size - 7, 1)
    focal = value, float(np.sqrt(np.linalg.inv(fit.normal)[6, 6] * variance))
    # The pose of one lens: a factor that is not there, and noise in it, shifts the camera forth and back.
    one_lens = np.linalg.solve(fit.normal[:6, :6], fit.normal[:6, 6]) * value
    carried = _carried(pair, intrinsics, rigid.moved(relative[None], one_lens[None])[0])[fit.good, 2]
    longer = np.log(pair.depth_after[fit.good] / np.where(carried > 0, carried, np.nan))
    longer = longer[np.isfinite(longer)]
    if len(longer) < LEAST:
        return Factors(focal, _UNKNOWN)
    middle = float(np.median(longer))
    noise = float(1.48 * np.median(np.abs(longer - middle)))
    return Factors(focal, (middle, float(1.25 * noise / np.sqrt(len(longer)))), noise)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Which matches are good, bool [m]; of those, residuals and weights float64 [n, 2]; the equations over a left
    tangent of the pose, translation first, and the log factor on the second focal length.
    """

    good: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray

    @property
    def determined(self) -> bool:
        """Whether the equations have one solution: where all depth is the same, a lens and a step ahead look alike."""
        unit = 1.0 / np.sqrt(np.diag(self.normal))
        return bool(np.linalg.eigvalsh(self.normal * np.outer(unit, unit))[0] > NULL)


def _fit(pair: DepthPair, intrinsics: np.ndarray, relative: np.ndarray, value: float) -> _Fit:
    grown = intrinsics * [np.exp(value), np.exp(value), 1.0, 1.0]
    points = _carried(pair, intrinsics, relative)
    seen = pinhole.project(points, grown)
    off = np.linalg.norm(seen - pair.after, axis=1)
    good = np.isfinite(off) & (off < FARTHEST)
    seen, residual = seen[good], (seen - pair.after)[good]
    by_pose = np.stack(pinhole.projection_rows(points[good], grown)).transpose(2, 0, 1)
    rows = np.concatenate([by_pose, (seen - grown[2:])[:, :, None]], 2)  # [n, 2, 7]
    weight = np.minimum(1.0, HUBER / np.maximum(np.abs(residual), 1e-9))
    normal = np.einsum("nki,nk,nkj->ij", rows, weight, rows) + 1e-9 * np.eye(7)
    return _Fit(good, residual, weight, normal, np.einsum("nki,nk,nk->i", rows, weight, residual))


def _carried(pair: DepthPair, intrinsics: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """The points of the first keyframe in the frame of the second, float64 [m, 3]."""
    local = pinhole.rays(pair.before, intrinsics) * pair.depth[:, None]
    return np.asarray(local @ relative[:3, :3].T + relative[:3, 3])


_UNKNOWN = 0.0, float("inf")
_NOTHING = Factors(_UNKNOWN, _UNKNOWN)


def directed_pairs(slam: Slam, pairs: list[Pair]) -> Iterator[DepthPair]:
    """Both directions of pairs of keyframes: errors of depth pull them apart. Where a rolling shutter was found they
    are without it: turning up or down, it stretches the picture as a lens does.
    """
    motions = None if slam.camera.readout is None else camera_motions(slam, len(slam.keyframes))
    for pair in pairs:
        first, second = slam.keyframes[pair.first], slam.keyframes[pair.second]
        for found in (_directed(pair, first, second, False), _directed(pair, second, first, True)):
            if len(found.depth) >= LEAST_MATCHES and np.median(_flow(found)) >= LEAST_FLOW:
                yield found if motions is None else _at_once(found, slam, motions)


def _at_once(pair: DepthPair, slam: Slam, motions: np.ndarray) -> DepthPair:
    """The pair without the readout of its images; motions: [n, 6], of the keyframes."""
    assert slam.camera.readout is not None
    first, second = pair.numbers
    camera = np.asarray(slam.intrinsics, np.float64)
    moving, size = (motions[first], motions[second]), slam.keyframes[first].size
    before, after = pair_at_once(
        pair.before, pair.after, pair.depth, pair.relative, moving, camera, size, slam.camera.readout
    )
    return replace(pair, before=before, after=after)


def _directed(pair: Pair, host: Keyframe, target: Keyframe, is_back: bool) -> DepthPair:
    points = pair.points
    slots, others, pixels = points.index_i, points.index_j, points.pixels_j
    if is_back:
        slots, others, pixels = others, slots, points.pixels_i
    depth = _depth(host, slots)
    known = np.isfinite(depth)
    relative = target.pose @ rigid.invert(host.pose)
    before = host.points.pixels[slots[known]].astype(np.float64)
    after = pixels[known].astype(np.float64)
    numbers = host.number, target.number
    return DepthPair(numbers, before, after, depth[known], _depth(target, others)[known], relative)


def _depth(keyframe: Keyframe, slots: np.ndarray) -> np.ndarray:
    """Measured depth of key points, NaN where there is none; slots: int [m], -1: no key point."""
    inverse = np.where(slots >= 0, keyframe.points.prior[slots], np.nan)
    return np.asarray(1.0 / np.where(inverse > 0, inverse, np.nan))


def _flow(pair: DepthPair) -> np.ndarray:
    return np.asarray(np.linalg.norm(pair.after - pair.before, axis=1))
