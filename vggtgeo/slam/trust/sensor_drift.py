"""With measured depth: do the lens and the unit of the depth stay what they are, from the first frame to the last?

A picture that grows because the camera goes forward grows by `t_z / z`, near parts more than far ones; one that grows
because the lens zooms grows everywhere alike. So the matches of two keyframes whose depth was measured say, with their
relative pose free, by what factor the focal length changed in between. And the depth that the first one measured,
carried by the pose of matches and one lens, says by what factor the second one measures longer: a depth camera that
warms up. Where the lens zooms, that pose is wrong, and nothing is said of the depth.

The logarithm of either factor is fitted to all pairs of a stretch of keyframes by a line over its first and one over
its second half; the covariance is the sandwich over keyframes.

Without measured depth nothing is asked here: see `zoom.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.stats import t as student_t

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.covisibility import Pair
from vggtgeo.slam.gauge import NULL
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.rolling_shutter import camera_motions, pair_at_once
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.finding import Finding

MOST_ZOOM = 0.08
"""Relative change of the focal length. Four clips in pieces of 40 to 500 frames have at most 0.028, and 0.053 with a
standard deviation of as much; enlarged by 1.3 at their end they have 0.16 to 0.38. From 8 % on a focal length that is
off as a whole is told, too."""
MOST_LONGER = 0.15
"""Relative change of the unit of depth. The clips have at most 0.057 (240 frames of corridor-office); made 1.4 times as
long over 60 frames they have 0.21 to 0.31."""
SIGMAS, CHANCE = 5.0, 1e-3
"""How sure it must be: standard deviations, and with few keyframes what Student's t makes of this chance."""
NOISE = 0.01
"""Standard deviation of the log factor of a pair beyond that of its matches: errors of depth that they share."""
MOST_NOISE = 0.02
"""Relative noise between two depths of a point above which nothing is said. Noisy depth does not tell near from far,
and a part of what steps forward enlarge looks like a zoom: `noise^2` of the variance of the logarithm of the depths
(0.3^2 in rooms), here 0.4 %, and a hundred keyframes that walk forward enlarge by `exp(10)`. The clips have 0.004 to
0.009."""
STRETCH = 100
"""Keyframes that are asked together. What a sensor measures wrongly at a distance adds up where a camera goes forward:
5.7 % in the 81 keyframes of corridor-office. A long run would be called wrong for it."""
MOST_PAIRS = 60
"""Of a stretch."""
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
KNOTS = 3


def check_sensors(slam: Slam) -> list[Finding]:
    """Do focal length and unit of depth change, between start, middle and end of some stretch of keyframes?"""
    found = []
    for stretch in stretches(len(slam.keyframes)):
        ends = max(slam.keyframes[stretch[0]].frame, 0), slam.keyframes[stretch[-1]].frame
        if ends[1] < 0:  # of a known map alone, which was judged when it was made
            continue
        lens, unit = changes(slam, stretch)
        when = f"between frames {ends[0]} and {ends[1]}"
        if lens is not None and lens.is_sure and abs(lens.value) > MOST_ZOOM:
            text = f"the lens zooms: the focal length changes by about {_percent(lens)} % {when}"
            found.append(Finding("calibration", "degraded", f"{text}, and one is assumed for all", *ends))
        elif unit is not None and unit.is_sure and abs(unit.value) > MOST_LONGER:
            text = f"the unit of the sensor's depth changes by about {_percent(unit)} % {when}"
            found.append(Finding("depth scale", "degraded", text, *ends, scale=True))
    return found


def changes(slam: Slam, stretch: range) -> tuple[Change | None, Change | None]:
    """Of focal length and of the unit of depth in a stretch of keyframes; None of what nobody can say."""
    pairs = list(depth_pairs(slam, stretch))
    factors = [compare(pair, np.asarray(slam.intrinsics, np.float64)) for pair in pairs]
    noise = [factor.noise for factor in factors if np.isfinite(factor.noise)]
    if not noise or np.median(noise) > MOST_NOISE:
        return None, None
    numbers = np.array([pair.numbers for pair in pairs], np.float64)
    return change(numbers, [factor.focal for factor in factors]), change(numbers, [factor.depth for factor in factors])


def stretches(keyframes: int) -> list[range]:
    """All keyframes, in stretches of about `STRETCH`."""
    ends = np.linspace(0, keyframes, max(round(keyframes / STRETCH), 1) + 1).astype(int)
    return [range(first, last) for first, last in pairwise(ends.tolist()) if last > first]


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


@dataclass(frozen=True, eq=False)
class Change:
    """The largest change of a logarithm between start, middle and end, its standard deviation, and how many of these
    make it sure.
    """

    value: float
    sigma: float
    needed: float

    @property
    def is_sure(self) -> bool:
        """Whether it is beyond chance."""
        return abs(self.value) > self.needed * self.sigma


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


def change(numbers: np.ndarray, factors: list[tuple[float, float]]) -> Change | None:
    """How a quantity changes over a run; None where too few pairs speak.

    numbers: [m, 2], first and second keyframe of each pair. factors: log ratio of the quantity, second to first, and
    its standard deviation.
    """
    value, sigma = np.array(factors, np.float64).reshape(-1, 2).T
    known = np.isfinite(sigma)
    numbers, value, information = numbers[known], value[known], 1.0 / (sigma[known] ** 2 + NOISE**2)
    keyframes, first = np.unique(numbers.min(1) if len(numbers) else [], return_inverse=True)
    free = len(keyframes) - (KNOTS - 1)
    if free < 2:
        return None
    knots = np.linspace(numbers.min(), numbers.max(), KNOTS)
    design = (_hats(numbers[:, 1], knots) - _hats(numbers[:, 0], knots))[:, 1:]  # the start is zero
    curve, weight, normal = np.zeros(KNOTS - 1), information, np.eye(KNOTS - 1)
    for _ in range(ITERATIONS):
        normal = design.T @ (design * weight[:, None]) + 1e-6 * np.eye(KNOTS - 1)
        curve = np.linalg.solve(normal, design.T @ (weight * value))
        off = np.abs(design @ curve - value) * np.sqrt(information)
        weight = information * np.minimum(1.0, ROBUST / np.maximum(off, 1e-9))
    gradient = np.zeros((len(keyframes), KNOTS - 1))
    np.add.at(gradient, first, design * (weight * (design @ curve - value))[:, None])
    inverse = np.linalg.inv(normal)
    covariance = len(keyframes) / free * inverse @ gradient.T @ gradient @ inverse
    between = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 1.0]])
    values, sigmas = between @ curve, np.sqrt(np.diag(between @ covariance @ between.T))
    most = int(np.argmax(np.abs(values)))
    needed = max(SIGMAS, float(student_t.isf(CHANCE / 2, free)))
    return Change(float(values[most]), float(sigmas[most]), needed)


_UNKNOWN = 0.0, float("inf")
_NOTHING = Factors(_UNKNOWN, _UNKNOWN)


def depth_pairs(slam: Slam, stretch: range) -> Iterator[DepthPair]:
    """Pairs of keyframes in a stretch, evenly over it."""
    inside = [pair for pair in slam.pairs if pair.first in stretch and pair.second in stretch]
    rows = np.unique(np.linspace(0, len(inside) - 1, MOST_PAIRS).astype(int)) if inside else ()
    yield from directed_pairs(slam, [inside[row] for row in rows])


def directed_pairs(slam: Slam, pairs: list[Pair]) -> Iterator[DepthPair]:
    """Both directions of pairs of keyframes: errors of depth pull them apart. Where a rolling shutter was found they
    are without it: turning up or down, it stretches the picture as a lens does.
    """
    motions = None if slam.readout is None else camera_motions(slam, len(slam.keyframes))
    for pair in pairs:
        first, second = slam.keyframes[pair.first], slam.keyframes[pair.second]
        for found in (_directed(pair, first, second, False), _directed(pair, second, first, True)):
            if len(found.depth) >= LEAST_MATCHES and np.median(_flow(found)) >= LEAST_FLOW:
                yield found if motions is None else _at_once(found, slam, motions)


def _at_once(pair: DepthPair, slam: Slam, motions: np.ndarray) -> DepthPair:
    """The pair without the readout of its images; motions: [n, 6], of the keyframes."""
    assert slam.readout is not None
    first, second = pair.numbers
    camera = np.asarray(slam.intrinsics, np.float64)
    moving, size = (motions[first], motions[second]), slam.keyframes[first].size
    before, after = pair_at_once(pair.before, pair.after, pair.depth, pair.relative, moving, camera, size, slam.readout)
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


def _percent(changed: Change) -> str:
    return f"{100 * np.expm1(abs(changed.value)):.0f}"


def _hats(at: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Values float64 [n, KNOTS] of the piecewise linear functions that are one at a knot and zero at the others."""
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - knots) / (knots[1] - knots[0]))
