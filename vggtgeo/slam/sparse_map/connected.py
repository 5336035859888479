"""Connected components of a map, by matches and odometry factors."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.slam.sparse_map.factors import MeasuredRotation
from vggtgeo.slam.sparse_map.map import Map


def submap_of(known: Map) -> np.ndarray:
    """Return the connected component of each keyframe, int [n], numbered by their first keyframes.

    A pair with matches of points or lines connects its keyframes, and so does any factor between two.
    """
    count = len(known.keyframes)
    ends = [factor.keyframes for factor in known.factors if not isinstance(factor, MeasuredRotation)]
    ends += [pair.key for pair in known.pairs if len(pair.points) + len(pair.lines)]
    first, second = np.array(ends, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(first)), (first, second)), (count, count))
    _, label = connected_components(graph, directed=False)
    _, start, inverse = np.unique(label, return_index=True, return_inverse=True)
    # Rank of each submap by its first keyframe: scipy's labels have no documented order.
    return np.asarray(np.argsort(np.argsort(start))[inverse])


def loop_edges(known: Map, apart: int) -> tuple[tuple[int, int], ...]:
    """Return pairs of keyframes, by their numbers, that observed one place at different times.

    They have matches or a measured relative pose, and are at least `apart` keyframes (those of a window) apart.
    """
    ends = [tie.keyframes for tie in known.odometry_factors] + [
        pair.key for pair in known.pairs if len(pair.points) + len(pair.lines)
    ]
    return tuple(sorted({(first, second) for first, second in ends if abs(second - first) >= apart}))
