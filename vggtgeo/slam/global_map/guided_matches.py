"""Guided matching in a map without measured depth: points are searched where the adjusted map predicts them.

Descriptors alone match what looks like nothing else in the image; of repeated texture and plain walls that is little.
An adjusted map predicts a point within a few pixels, where few others resemble it, also in keyframes that were never
compared. The search follows an adjustment: before one, it confirms the drift of the poses instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from vggtgeo.models.classical import PatchAlignment, can_search, search_near, search_tree
from vggtgeo.models.roles import PointMatches
from vggtgeo.slam.global_map.padded_shapes import MAX_NEIGHBOURS
from vggtgeo.slam.sparse_map.covisibility import (
    MIN_MATCHES,
    MIN_OVERLAP,
    Pair,
    overlap,
    some_points,
    without_matches,
)
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import Map, submap_of
from vggtgeo.slam.tracking.local_map_tracking import MAX_TURN, expected_pixels

RADIUS = 0.008
"""Largest distance of a match from its prediction, in focal lengths: errors of a map are angles, and in a small image a
radius in pixels finds what confirms them (`benchmarks/keyframe_spacing.py`, whose images have 240 pixels)."""

REFINEMENT = PatchAlignment()
"""As of the matches by descriptors alone, whose noise the adjustment assumes."""


def guided_pairs(known: Map, intrinsics: np.ndarray) -> tuple[Pair, ...]:
    """Return the pairs of the map with further matches, and pairs of keyframes that are predicted to see the same.

    Without descriptors that can be compared one by one, return the pairs as they are.
    """
    if not all(can_search(keyframe.features) for keyframe in known.keyframes):
        return known.pairs
    own = {pair.key: pair for pair in known.pairs}
    trees = [search_tree(keyframe.features) for keyframe in known.keyframes]

    def searched(key: tuple[int, int]) -> Pair | None:
        pair = own.get(key)
        found = _further_matches(pair or without_matches(*key), known.keyframes, trees, intrinsics)
        return found if pair is not None or len(found.points) >= MIN_MATCHES else None

    candidates = [*own, *_predicted_pairs(known, intrinsics, set(own))]
    # Not in threads: its calls of NumPy take microseconds, and threads wait for Python's lock, a third longer in all.
    return tuple(pair for pair in map(searched, candidates) if pair is not None)


def _predicted_pairs(known: Map, intrinsics: np.ndarray, but: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the pairs of keyframes of one submap that should share points, in a similar viewing direction.

    Of each keyframe only those that should share most: the adjustment uses no more (`MAX_NEIGHBOURS`).
    """
    label, points = submap_of(known), [some_points(keyframe, intrinsics) for keyframe in known.keyframes]
    rotations = np.array([keyframe.pose[:3, :3] for keyframe in known.keyframes])
    # `trace(R1 R2') = 1 + 2 cos(angle)`.
    turned = np.einsum("nij,mij->nm", rotations, rotations) < 1 + 2 * np.cos(MAX_TURN)
    labels = np.array([label[keyframe.number] for keyframe in known.keyframes])
    shares = np.zeros(turned.shape)
    for first, second in np.argwhere(np.triu(~turned & (labels[:, None] == labels), 1)):
        shares[first, second] = overlap(points[first], known.keyframes[second], intrinsics)
    shares += shares.T
    best = np.argsort(-shares, axis=1, kind="stable")[:, :MAX_NEIGHBOURS]
    chosen = {(min(host, other), max(host, other)) for host, row in enumerate(best.tolist()) for other in row}
    return sorted(pair for pair in chosen - but if shares[pair] > MIN_OVERLAP)


def _further_matches(pair: Pair, keyframes: Sequence[Keyframe], trees: list[cKDTree], intrinsics: np.ndarray) -> Pair:
    """Return the pair with the matches of points of either keyframe that the other shows near their projection."""
    first, second = (keyframes[number] for number in pair.key)
    own = pair.points
    there = _near_projection(first, second, own.index_i, trees[pair.second], intrinsics)
    matched = np.concatenate([own.index_j, there.index_j])
    back = _near_projection(second, first, matched, trees[pair.first], intrinsics)
    index_i = np.concatenate([own.index_i, there.index_i, back.index_j])
    index_j = np.concatenate([own.index_j, there.index_j, back.index_i])
    # A key point is matched once, to the one that was found first; -1 is no key point.
    lone = np.where(index_j < 0, -1 - np.arange(len(index_j)), index_j)
    once = _first(index_i) & _first(lone)
    added = PointMatches(
        index_i,
        index_j,
        np.concatenate([own.pixels_i, there.pixels_i, back.pixels_j]),
        np.concatenate([own.pixels_j, there.pixels_j, back.pixels_i]),
        np.concatenate([own.confidence, there.confidence, back.confidence]),
    )
    return replace(pair, points=added.select(once))


def _near_projection(
    of: Keyframe, other: Keyframe, matched: np.ndarray, tree: cKDTree, intrinsics: np.ndarray
) -> PointMatches:
    """Return the matches of points of `of` that `other` shows near their projection, aligned by the images.

    matched: points that have a match already.
    """
    index, _, pixels = expected_pixels(of, other.pose, intrinsics)
    known = of.points.determined[index] & ~np.isin(index, matched)
    radius = RADIUS * float(intrinsics[0])
    found = search_near(of.features, index[known], pixels[known], other.features, tree, radius=radius)
    images = of.features.descriptors.gray, other.features.descriptors.gray
    refined, _ = REFINEMENT.refine(*images, found.pixels_i, found.pixels_j)
    return replace(found, pixels_j=refined)


def _first(values: np.ndarray) -> np.ndarray:
    """Return where each value occurs for the first time, bool [m]."""
    found = np.zeros(len(values), bool)
    found[np.unique(values, return_index=True)[1]] = True
    return found
