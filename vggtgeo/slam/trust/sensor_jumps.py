"""With measured depth: do the lens and the unit of the depth change at once, or within a few keyframes?

A depth camera that starts again in another mode, a phone's app that finds another scale, recordings that were joined:
from some frame on all depth is a fifth longer, and so is the path. `sensor_drift.py` looks for what changes steadily:
in a map of thirty keyframes the few pairs across a jump are outliers to its lines. `enlargement.py` looks from picture
to picture, and has to leave room for steps of the camera.

So the pairs of keyframes across each place between two neighbours are asked, by the factors of `sensor_drift.py`: the
motion of their own matches explains what they see, whatever the map made of it. The neighbours are asked first, and
where they speak of a jump, the keyframes next to them, which have to say the same. The sum of the logarithms over up to
`WITHIN` places is a change; a longer sum adds up what a sensor measures wrongly at a distance.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vggtgeo.slam.covisibility import Pair
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.sensor_drift import MOST_ZOOM, SIGMAS, compare, directed_pairs

MOST_CHANGE = MOST_ZOOM
"""Of the logarithm of either factor: what is told of a focal length, or a scale, that is off as a whole. Over any 1 to
20 places right depth has at most 0.030 (64 and 77 keyframes of building-walk and corridor-office, 15 of redkitchen, 6
of icl-office), 0.064 over 20 of all of redkitchen, 0.053 with 3 % of noise a metre, and right lenses 0.020 to 0.062;
depth that is 1.2 times as long from a frame on has 0.181 to 0.185 at one place, depth that is late in a part 0.17."""
LEAST_SIGMA = 0.005
"""Standard deviation of a logarithm between two neighbours, at least: over 20 places nothing below 0.11 is told. Right
ones spread by 0.001 to 0.009."""
MOST_SIGMA = MOST_CHANGE / SIGMAS
"""Of a logarithm by its own pair: one that knows it worse says nothing. Straight on before a white wall the lens is
left open: in building-walk, frames 43 to 49, by 0.03 to 0.05, and the six values there, -0.12 in their median, were
taken for a zoom."""
WITHIN = 20
"""Places between keyframes."""
REACH = 2
"""Keyframes that a pair is apart at most."""
LEAST_PAIRS = 2
"""Across a jump: the matches of one may be those of something that moves."""


def check_jumps(slam: Slam) -> Iterator[Finding]:
    """Whether one lens and one unit hold on both sides of each place between two keyframes."""
    factors = neighbour_factors(slam)
    lens = sudden_changes(factors[:, 0])
    for first, last, _ in lens:  # the motion of one lens is wrong there, and nothing is said of the depth
        factors[first:last, 1] = np.nan
    for first, last, value in lens:
        yield from _told(slam, first, last, f"the focal length changes, by a factor of {np.exp(value):.2f}", False)
    for first, last, value in sudden_changes(factors[:, 1]):
        text = f"the unit of the sensor's depth changes, by a factor of {np.exp(value):.2f}"
        yield from _told(slam, first, last, text, True)


def _told(slam: Slam, first: int, last: int, text: str, scale: bool) -> Iterator[Finding]:
    start, end = (slam.keyframes[place].frame for place in (first, last))
    if end >= 0:  # not of a known map, which was judged when it was made
        text = f"frames {max(start, 0)} to {end}: {text}, and one is assumed for all"
        yield Finding("depth scale" if scale else "calibration", "degraded", text, scale=scale)


def sudden_changes(steps: np.ndarray) -> list[tuple[int, int, float]]:
    """First and last place of each change that is beyond chance, and its logarithm, in order; of those that overlap the
    surest.

    steps: float64 [n], logarithm of a factor between each keyframe and the next, NaN where nothing speaks.
    """
    known = np.abs(steps[np.isfinite(steps)])
    if not len(known):
        return []
    sigma = max(1.48 * float(np.median(known)), LEAST_SIGMA)
    curve = np.append(0.0, np.cumsum(np.nan_to_num(steps)))
    beyond: list[tuple[float, int, int, float]] = []
    for length in range(1, min(WITHIN, len(steps)) + 1):
        change = curve[length:] - curve[:-length]
        sigmas = np.abs(change) / (sigma * np.sqrt(length))
        told = (np.abs(change) > MOST_CHANGE) & (sigmas > SIGMAS)
        beyond += [(-sigmas[n], n, n + length, float(change[n])) for n in np.flatnonzero(told).tolist()]
    found: list[tuple[int, int, float]] = []
    for _, first, last, value in sorted(beyond):
        if all(last <= start or first >= end for start, end, _ in found):
            found.append((first, last, value))
    return sorted(found)


def neighbour_factors(slam: Slam) -> np.ndarray:
    """Logarithms of the factors between each keyframe and the next, of the focal length and of the unit of depth,
    float64 [n - 1, 2], NaN where nothing speaks.
    """
    places = range(len(slam.keyframes) - 1)
    near = [pair for pair in slam.pairs if pair.second - pair.first <= REACH]
    said = _compared(slam, [pair for pair in near if pair.second - pair.first == 1])
    found = np.array([_medians([said.get((n, n + 1), [])], 1) for n in places]).reshape(-1, 2)
    doubtful = {n for n in places if not (np.abs(found[n]) <= MOST_CHANGE / 2).all()}
    crossing = {n: [pair for pair in near if pair.first <= n < pair.second] for n in doubtful}
    wider = {pair.key: pair for pairs in crossing.values() for pair in pairs if pair.key not in said}
    said |= _compared(slam, list(wider.values()))
    for place, pairs in crossing.items():
        found[place] = _medians([said.get(pair.key, []) for pair in pairs], LEAST_PAIRS)
    return found


def _compared(slam: Slam, pairs: list[Pair]) -> dict[tuple[int, int], list[np.ndarray]]:
    """What both directions of each pair say, by its keyframes: float64 [2] each, focal length and unit, the later over
    the earlier keyframe, NaN where unknown, or known too badly.
    """
    said: dict[tuple[int, int], list[np.ndarray]] = {}
    for directed in directed_pairs(slam, pairs):
        first, second = directed.numbers
        factors = compare(directed, np.asarray(slam.intrinsics, np.float64))
        values = [value if sigma <= MOST_SIGMA else np.nan for value, sigma in (factors.focal, factors.depth)]
        key = min(first, second), max(first, second)
        said.setdefault(key, []).append(np.array(values) if second > first else -np.array(values))
    return said


def _medians(said: list[list[np.ndarray]], least: int) -> np.ndarray:
    """Over what some pairs say, float64 [2]; NaN where fewer than `least` of them speak."""
    found = np.full(2, np.nan)
    for column in range(2):
        known = [[value[column] for value in pair if np.isfinite(value[column])] for pair in said]
        if sum(bool(values) for values in known) >= least:
            found[column] = np.median(np.concatenate(known))
    return found
