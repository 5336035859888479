"""Which keyframes hang together: the pieces of a map, by its matches and tracked motions."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.slam.sparse_map.factors import MeasuredRotation
from vggtgeo.slam.state import Slam


def piece_of(slam: Slam) -> np.ndarray:
    """Piece of each keyframe, int [n]; 0 is that of the first keyframe, and so on in their order.

    A pair joins with enough matches of points or lines, a factor always: a tracked motion, the unit of a new map.
    """
    count = len(slam.keyframes)
    ends = [factor.keyframes for factor in slam.map.factors if not isinstance(factor, MeasuredRotation)]
    ends += [pair.key for pair in slam.map.pairs if len(pair.points) + len(pair.lines)]
    first, second = np.array(ends, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(first)), (first, second)), (count, count))
    _, label = connected_components(graph, directed=False)
    _, start, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(start))[inverse])


def pieces_by_size(slam: Slam) -> tuple[tuple[int, ...], ...]:
    """Numbers of the keyframes of each piece: first the piece that most frames with a pose hang on."""
    if not slam.keyframes:
        return ()
    label = piece_of(slam)
    hanging = np.bincount(label[[r.reference for r in slam.frames if r.tracked]], minlength=label.max(initial=-1) + 1)
    order = np.argsort(-hanging, kind="stable")
    return tuple(tuple(int(number) for number in np.nonzero(label == piece)[0]) for piece in order)


def loop_edges(slam: Slam, apart: int) -> tuple[tuple[int, int], ...]:
    """Pairs of keyframes, by their numbers, that saw one place at different times: joined by matches or by a measured
    motion, and at least `apart` keyframes (those of a window) apart.
    """
    ends = [tie.keyframes for tie in slam.map.odometry_factors] + [
        pair.key for pair in slam.map.pairs if len(pair.points) + len(pair.lines)
    ]
    return tuple(sorted({(first, second) for first, second in ends if abs(second - first) >= apart}))


def lost_stretches(slam: Slam) -> tuple[tuple[int, int], ...]:
    """First and last row of `slam.frames` of each stretch of frames that have no pose."""
    lost = np.array([False, *(not record.tracked for record in slam.frames), False])
    first, past = np.flatnonzero(np.diff(lost)).reshape(-1, 2).T
    return tuple((int(i), int(j) - 1) for i, j in zip(first, past, strict=True))
