"""Loops: keyframes that saw one place at different times. Proposed by where the current estimate says that they look,
and, whatever the drift, by what they look like; verified by geometry.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models.classical import can_search, pose_information
from vggtgeo.models.roles import GeometryResult, LineMatches, PoseQuery
from vggtgeo.slam.global_map.straightening import Loop, straightened
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.connected import piece_of
from vggtgeo.slam.sparse_map.covisibility import Pair, overlap, some_points
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.units import ratio_of_units
from vggtgeo.slam.state import Slam
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.tracking.track import PIXEL_SIGMA

MIN_VISIBLE, MAX_TURN = 0.4, np.deg2rad(40)
"""Share of one keyframe's points that another should see, and angle between them, for a pair to be proposed."""
MIN_INLIERS = 50
"""A loop needs more inliers of PnP than this: keyframes far apart in time have no predicted pose to check them by."""
FLOOR = (0.02, np.deg2rad(0.5))
"""Standard deviation of a verified pose that no number of matches removes, metres and radians: the depths that it
rests on are those of one keyframe, and share its error."""


def close_loops(slam: Slam, roles: Roles, settings: SlamSettings) -> Slam:
    """Match keyframes that should see the same place, or look as if they did, but have not been matched yet.

    Where what is found contradicts the map by more than its adjustment can mend, the map is straightened first, and
    searched once more.
    """
    label, known = piece_of(slam.map), {pair.key for pair in slam.map.pairs}
    proposed = list(dict.fromkeys([*_by_estimate(slam, settings, known), *_by_appearance(slam, settings, known)]))
    found = _verified(slam, proposed, label, roles)
    before, (straight, believed) = slam, straightened(slam, found)
    slam = replace(straight, map=replace(straight.map, pairs=(*slam.map.pairs, *(loop.pair for loop in believed))))
    if straight is before:
        return slam
    known |= {loop.pair.key for loop in found}
    more = _verified(slam, _by_estimate(slam, settings, known), piece_of(slam.map), roles)
    return replace(
        slam, map=replace(slam.map, pairs=(*slam.map.pairs, *(loop.pair for loop in more if loop.agrees(slam))))
    )


def _verified(slam: Slam, proposed: list[tuple[int, int]], label: np.ndarray, roles: Roles) -> list[Loop]:
    """Those of the proposed pairs that geometry confirms. Pieces of free scale have units of their own."""
    comparable = [(first, second) for first, second in proposed if slam.metric or label[first] == label[second]]

    def verified(pair: tuple[int, int]) -> Loop | None:
        first, second = (slam.keyframes[number] for number in pair)
        return verify(first, second, roles, slam.intrinsics)

    loops = map_in_threads(verified, comparable, alone=not can_search(slam.keyframes[0].features))
    return [loop for loop in loops if loop is not None]


def _by_estimate(slam: Slam, settings: SlamSettings, known: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Unmatched pairs by how much of one should be visible in the other, the best few of each keyframe."""
    chosen = []
    samples = [some_points(keyframe, slam.intrinsics) for keyframe in slam.keyframes]
    for second in slam.keyframes:
        scored = []
        for first in slam.keyframes[: max(second.number - settings.window.size, 0)]:
            if (first.number, second.number) in known:
                continue
            turned = rigid.angle_between(first.pose, second.pose)
            if turned >= MAX_TURN:
                continue
            share = overlap(samples[first.number], second, slam.intrinsics)
            if share > MIN_VISIBLE:
                # Matching fails with the angle between views: a radian costs as much as the whole overlap.
                scored.append((share - turned, first.number))
        chosen += [
            (number, second.number) for _, number in sorted(scored, reverse=True)[: settings.refinement.loop_candidates]
        ]
    return chosen


def _by_appearance(slam: Slam, settings: SlamSettings, known: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """For each keyframe the earlier one that looks most like it, if it does so as much as those that it is matched to.

    A threshold that is the image's own: a wall looks like any wall, a shelf like no other.
    """
    seen = [keyframe for keyframe in slam.keyframes if keyframe.place is not None]
    if settings.refinement.loop_candidates < 1 or not seen:
        return []
    similarity = np.full((len(slam.keyframes),) * 2, -np.inf)
    numbers = np.array([keyframe.number for keyframe in seen])
    places = np.stack([keyframe.place for keyframe in seen if keyframe.place is not None])
    similarity[np.ix_(numbers, numbers)] = places @ places.T
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


def verify(first: Keyframe, second: Keyframe, roles: Roles, intrinsics: np.ndarray) -> Loop | None:
    """Matches that agree on one pose of the second keyframe in the first one's points, whatever the drift."""
    matches = roles.points.match(first.features, second.features)
    inverse = first.points.inverse_depth[matches.index_i]
    known = np.isfinite(inverse)
    matches, inverse = matches.select(known), inverse[known]
    points = rigid.unproject(matches.pixels_i, inverse, first.pose, intrinsics)
    guess = roles.geometry.locate(PoseQuery(second.image, intrinsics, points, matches.pixels_j, matches.confidence))
    if guess.result is not GeometryResult.SUCCESS or guess.inlier_count <= MIN_INLIERS:
        return None
    agreed, empty = matches.select(guess.inliers), np.zeros(0, int)
    pair = Pair(first.number, second.number, agreed, LineMatches(empty, empty, np.zeros(0)))
    relative = rigid.orthonormal(guess.pose @ rigid.invert(first.pose))
    information = pose_information(guess.pose, points[guess.inliers], intrinsics, PIXEL_SIGMA)
    # Covariances add: matching noise, and what all matches share.
    floor = np.diag(np.repeat(FLOOR, 3) ** 2)
    information = np.linalg.inv(np.linalg.inv(information + 1e-9 * np.eye(6)) + floor)
    ratio = ratio_of_units(first, second, agreed.select(agreed.index_j >= 0), relative, intrinsics)
    return Loop(pair, MeasuredRelativePose(*pair.key, relative, information), ratio)
