"""Loop closure: keyframes that observed one place at different times.

Proposed by the estimated poses and, whatever the drift, by appearance; verified by geometry.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import inverse_information
from vggtgeo.models.classical import can_search, pose_information
from vggtgeo.models.roles import GeometryResult, PoseQuery
from vggtgeo.slam.global_map.drift_correction import Loop, correct_drift
from vggtgeo.slam.global_map.pose_graph import ScaleRatio
from vggtgeo.slam.settings.groups import KeyframeSettings
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.covisibility import NO_LINES, Pair, overlap, some_points
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import PIXEL_SIGMA, Keyframe
from vggtgeo.slam.sparse_map.map import measured_ratio, submap_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.threads import map_in_threads

MIN_VISIBLE, MAX_TURN = 0.4, np.deg2rad(40)
"""Share of one keyframe's points inside the other's image, and angle between them, for a pair to be proposed: with
less, or farther apart, descriptors hardly give `MIN_INLIERS`, and verifying a pair costs as much as tracking a
frame."""
MAX_CANDIDATES = 3
"""Pairs that each keyframe proposes by the estimated poses."""
MIN_INLIERS = KeyframeSettings.min_inliers
"""Minimum number of PnP inliers of a loop (exclusive): as many as a frame needs that is tracked well by a keyframe.
Keyframes far apart in time have no predicted pose for a check."""
MAX_RATIO_ERROR = 0.3
"""Largest standard error of the logarithm of a measured scale ratio: larger ones are not normally distributed."""
FLOOR = (0.02, np.deg2rad(0.5))
"""Systematic error of a verified pose, metres and radians: all its depths are those of one keyframe and share its
error, 1 % at 2 m."""


def close_loops(slam: Slam, roles: Roles, settings: SlamSettings) -> Slam:
    """Match keyframes that are expected to show one place by their poses or by appearance.

    If the loops contradict the map by more than its adjustment can correct, a pose graph corrects it first, and it is
    searched again.
    """
    known = {pair.key for pair in slam.map.pairs}
    proposed = list(dict.fromkeys([*_by_estimate(slam, settings, known), *_by_appearance(slam, settings, known)]))
    found = verified_loops(slam, _in_one_scale(slam, proposed), roles)
    corrected, accepted = correct_drift(slam, found)
    closed = corrected.with_map(pairs=(*slam.map.pairs, *(loop.pair for loop in accepted)))
    if corrected is slam:
        return closed
    known |= {loop.pair.key for loop in found}
    more = verified_loops(closed, _in_one_scale(closed, _by_estimate(closed, settings, known)), roles)
    return closed.with_map(pairs=(*closed.map.pairs, *(loop.pair for loop in more if loop.agrees(closed))))


def _in_one_scale(slam: Slam, proposed: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the pairs whose keyframes have one scale: submaps without metric depth have one each."""
    label = submap_of(slam.map)
    return [(first, second) for first, second in proposed if slam.metric or label[first] == label[second]]


def verified_loops(slam: Slam, proposed: list[tuple[int, int]], roles: Roles) -> list[Loop]:
    """Return the verified ones of the proposed pairs."""

    def verified(pair: tuple[int, int]) -> Loop | None:
        first, second = (slam.keyframes[number] for number in pair)
        return _verified(first, second, roles, slam.intrinsics)

    loops = map_in_threads(verified, proposed, alone=not can_search(slam.keyframes[0].features))
    return [loop for loop in loops if loop is not None]


def _by_estimate(slam: Slam, settings: SlamSettings, known: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Propose unmatched pairs by the predicted overlap, the best few of each keyframe."""
    chosen = []
    samples = [some_points(keyframe, slam.intrinsics) for keyframe in slam.keyframes]
    for second in slam.keyframes:
        scored = []
        for first in slam.keyframes[: max(second.number - settings.window.size, 0)]:
            turned = rigid.angle_between(first.pose, second.pose)
            if turned >= MAX_TURN or (first.number, second.number) in known:
                continue
            share = overlap(samples[first.number], second, slam.intrinsics)
            if share > MIN_VISIBLE:
                # Matching fails with the angle between views: a radian costs as much as the whole overlap.
                scored.append((share - turned, first.number))
        chosen += [(number, second.number) for _, number in sorted(scored, reverse=True)[:MAX_CANDIDATES]]
    return chosen


def _by_appearance(slam: Slam, settings: SlamSettings, known: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Propose for each keyframe the most similar earlier one, if it is as similar as those that it is matched to.

    This threshold adapts to the image: a wall resembles any wall, a shelf no other.
    """
    every = ((keyframe.number, keyframe.global_descriptor) for keyframe in slam.keyframes)
    known_descriptors = {number: descriptor for number, descriptor in every if descriptor is not None}
    if not known_descriptors:
        return []
    numbers, descriptors = np.array(list(known_descriptors)), np.stack(list(known_descriptors.values()))
    similarity = np.full((len(slam.keyframes),) * 2, -np.inf)
    similarity[np.ix_(numbers, numbers)] = descriptors @ descriptors.T
    neighbours: dict[int, list[int]] = {}
    for first, second in known:
        neighbours.setdefault(second, []).append(first)
    chosen = []
    for number in numbers:
        near = [other for other in neighbours.get(int(number), []) if number - other <= settings.window.size]
        earlier = similarity[number, : max(number - settings.window.size, 0)]
        if not near or not len(earlier):
            continue
        best = int(np.argmax(earlier))
        if earlier[best] >= np.median(similarity[number, near]) and (best, int(number)) not in known:
            chosen.append((best, int(number)))
    return chosen


def _verified(first: Keyframe, second: Keyframe, roles: Roles, intrinsics: np.ndarray) -> Loop | None:
    """Return the matches that agree on one pose of the second keyframe relative to the first one's points."""
    matches = roles.points.match(first.features, second.features)
    inverse = first.points.inverse_depth[matches.index_i]
    known = np.isfinite(inverse)
    matches, inverse = matches.select(known), inverse[known]
    points = rigid.unproject(matches.pixels_i, inverse, first.pose, intrinsics)
    guess = roles.geometry.locate(PoseQuery(second.image, intrinsics, points, matches.pixels_j, matches.confidence))
    if guess.result is not GeometryResult.SUCCESS or guess.inlier_count <= MIN_INLIERS:
        return None
    agreed = matches.select(guess.inliers)
    pair = Pair(first.number, second.number, agreed, NO_LINES)
    relative = rigid.orthonormal(guess.pose @ rigid.invert(first.pose))
    information = pose_information(guess.pose, points[guess.inliers], intrinsics, PIXEL_SIGMA)
    # Covariances add: matching noise, and what all matches share.
    floor = np.diag(np.repeat(FLOOR, 3) ** 2)
    information = np.linalg.inv(inverse_information(information) + floor)
    ratio, error = measured_ratio(first, second, agreed.select(agreed.index_j >= 0), relative, intrinsics)
    scale = ScaleRatio(*pair.key, ratio, error) if error < MAX_RATIO_ERROR else None
    return Loop(pair, MeasuredRelativePose(*pair.key, relative, information), scale)
