"""Without metric depth the unit of length is handed on from keyframe to keyframe: how well?

Between keyframes `k` and `k + 1` only those landmarks hand it on whose depth both sides know by themselves: the
keyframes up to `k` by the parallax between them, and those from `k + 1` on. A landmark of host `i` whose pixel in `j`
moves by `s_j` where the logarithm of its depth does is known to `v = sigma^2 / sum_j s_j^2` by the `j` of one side. A
match across hands the scale on with the variance `v_before + v_after + FLOOR^2`, the tracked motion alone with
`ALONE^2`. Matches that share errors count as fewer. Steps add up as a random walk.

It is what a count of inliers cannot tell: frames that turn on the spot, or come out of a white wall, have seventeen
matches of hardly any parallax. Frames 160 to 239 of building-walk without depth were 29.9 cm off where lengths halve at
frame 215: there this says 28 % for one step, and nowhere else more than 9 %.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.global_map.pose_uncertainty import SHARED_ERRORS
from vggtgeo.slam.sparse_map.connected import piece_of
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.finding import Finding

MOST_DRIFT = 0.15
"""Expected relative drift of the scale over the run. Pieces of redkitchen have 0.03, of corridor-office 0.09 to 0.12;
of building-walk 0.05 to 0.12 and, across its white walls, 0.19 to 0.22, where they drift by as much, 3 to 11 cm off;
those that were 16 to 30 cm off have 0.26 to 0.36."""
LEAST_SHARE = 0.1
"""Of the way, on the shorter side of a step: who stands still behind it has no use for a scale."""
LEAST_OF_BOTH = 0.5
"""Of all matches: those of key points in either keyframe."""
PIXELS = 1.0
"""Standard deviation of a match."""
FLOOR = 0.02
"""Relative standard deviation of a depth that no parallax removes."""
ALONE = 0.5
"""Of a step that no landmark hands on."""
FARTHEST = 50
"""Keyframes over which a match counts: a loop ties its ends, and costs a long run a sum at each step between them."""


def check_hand_over(slam: Slam) -> list[Finding]:
    """A scale that is free and is handed on too badly to be one.

    Of a matcher whose targets are no key points nothing is said: its matches are of no landmark of the other keyframe.
    """
    if slam.metric:
        return []
    of_both = sum(np.count_nonzero(pair.points.index_j >= 0) for pair in slam.map.pairs)
    if of_both < LEAST_OF_BOTH * sum(len(pair.points) for pair in slam.map.pairs):
        return []
    sigma = hand_over_sigma(slam)
    frames = np.array([keyframe.frame for keyframe in slam.keyframes])
    centres = np.array([rigid.centre(keyframe.pose) for keyframe in slam.keyframes])
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    shorter = np.minimum(way[:-1], way[-1] - way[1:])
    inner = np.isfinite(sigma) & (shorter >= LEAST_SHARE * way[-1])
    drift = float(np.sqrt(np.sum(sigma[inner] ** 2)))
    if drift <= MOST_DRIFT:
        return []
    weakest = frames[:-1][inner][np.argmax(sigma[inner])]
    text = (
        f"the scale, which is free, is handed on by few points, fewest at frame {weakest}: it may drift by "
        f"{100 * drift:.0f} % over the run"
    )
    return [Finding("scale", "degraded", text)]


def hand_over_sigma(slam: Slam) -> np.ndarray:
    """Relative standard deviation of the scale behind each keyframe against that before it, float64 [n - 1]; NaN where
    a piece of map has fewer than two keyframes on either side.
    """
    count, label = len(slam.keyframes), piece_of(slam.map)
    sigma = np.full(max(count - 1, 0), np.nan)
    seen, across = _sensitivities(slam), _matches_across(slam)
    for step in range(count - 1):
        inside = label == label[step]
        if label[step + 1] != label[step] or inside[: step + 1].sum() < 2 or inside[step + 1 :].sum() < 2:
            continue
        known: dict[tuple[int, bool], np.ndarray] = {}
        best: dict[int, np.ndarray] = {}
        for first, second, slots, others in across[step]:
            before, after = (_known(known, seen, slam, host, step) for host in (first, second))
            with np.errstate(divide="ignore"):
                variance = PIXELS**2 / before[slots] + PIXELS**2 / after[others] + FLOOR**2
            of_second = best.setdefault(second, np.zeros(len(slam.keyframes[second].points.pixels)))
            np.maximum.at(of_second, others, 1.0 / variance)
        # A landmark is seen by several keyframes behind the step, and counts once: by the one that knows most.
        information = max((values.sum() for values in best.values()), default=0.0) / SHARED_ERRORS
        sigma[step] = 1.0 / np.sqrt(information + 1.0 / ALONE**2)
    return sigma


_Seen = list[list[tuple[int, np.ndarray, np.ndarray]]]


def _sensitivities(slam: Slam) -> _Seen:
    """Of each keyframe as a host: the other keyframe of a pair, slots [m], and `s^2` of each [m], pixels squared."""
    intrinsics = np.asarray(slam.intrinsics, np.float64)
    seen: _Seen = [[] for _ in slam.keyframes]
    for pair in slam.map.pairs:
        first, second = slam.keyframes[pair.first], slam.keyframes[pair.second]
        slots, others = pair.points.index_i, pair.points.index_j[pair.points.index_j >= 0]
        seen[pair.first].append((pair.second, slots, _moved(first, second, slots, intrinsics)))
        seen[pair.second].append((pair.first, others, _moved(second, first, others, intrinsics)))
    return seen


def _moved(host: Keyframe, target: Keyframe, slots: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """By how much pixels of the target move where the logarithm of a depth does, squared [m]; zero of no depth."""
    inverse = host.points.inverse_depth[slots]
    relative = target.pose @ rigid.invert(host.pose)
    step = relative[:3, 3] * inverse[:, None]
    there = pinhole.rays(host.points.pixels[slots], intrinsics) @ relative[:3, :3].T + step
    with np.errstate(all="ignore"):
        slope = (step[:, :2] - there[:, :2] * step[:, 2:] / there[:, 2:]) / there[:, 2:]
    squared = np.sum((intrinsics[:2] * slope) ** 2, 1)
    return np.where(np.isfinite(squared) & (there[:, 2] > 0) & (inverse > 0), squared, 0.0)


def _matches_across(slam: Slam) -> list[list[tuple[int, int, np.ndarray, np.ndarray]]]:
    """Of each step from a keyframe to the next: the pairs on whose two sides they are, and their slots."""
    across: list[list[tuple[int, int, np.ndarray, np.ndarray]]] = [[] for _ in slam.keyframes]
    for pair in slam.map.pairs:
        if pair.second - pair.first <= FARTHEST:
            both = pair.points.index_j >= 0
            of_pair = pair.first, pair.second, pair.points.index_i[both], pair.points.index_j[both]
            for step in range(pair.first, pair.second):
                across[step].append(of_pair)
    return across


def _known(known: dict[tuple[int, bool], np.ndarray], seen: _Seen, slam: Slam, host: int, step: int) -> np.ndarray:
    """Information on the depth of each slot of a host by the keyframes of its own side of a step, pixels squared."""
    is_before = host <= step
    if (host, is_before) not in known:
        total = np.zeros(len(slam.keyframes[host].points.pixels))
        for other, slots, squared in seen[host]:
            if (other <= step) == is_before:
                np.add.at(total, slots, squared)
        known[host, is_before] = total
    return known[host, is_before]
