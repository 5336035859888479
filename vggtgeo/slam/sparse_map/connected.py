"""Which keyframes hang together: the pieces of a map, by its matches and tracked motions."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.slam.sparse_map.factors import MeasuredRotation
from vggtgeo.slam.sparse_map.map import Map


def piece_of(known: Map) -> np.ndarray:
    """Piece of each keyframe, int [n]; 0 is that of the first keyframe, and so on in their order.

    A pair joins with enough matches of points or lines, a factor always: a tracked motion, the unit of a new map.
    """
    count = len(known.keyframes)
    ends = [factor.keyframes for factor in known.factors if not isinstance(factor, MeasuredRotation)]
    ends += [pair.key for pair in known.pairs if len(pair.points) + len(pair.lines)]
    first, second = np.array(ends, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(first)), (first, second)), (count, count))
    _, label = connected_components(graph, directed=False)
    _, start, inverse = np.unique(label, return_index=True, return_inverse=True)
    # Rank of each piece by its first keyframe: scipy's labels have no documented order.
    return np.asarray(np.argsort(np.argsort(start))[inverse])


def loop_edges(known: Map, apart: int) -> tuple[tuple[int, int], ...]:
    """Pairs of keyframes, by their numbers, that saw one place at different times: joined by matches or by a measured
    motion, and at least `apart` keyframes (those of a window) apart.
    """
    ends = [tie.keyframes for tie in known.odometry_factors] + [
        pair.key for pair in known.pairs if len(pair.points) + len(pair.lines)
    ]
    return tuple(sorted({(first, second) for first, second in ends if abs(second - first) >= apart}))
