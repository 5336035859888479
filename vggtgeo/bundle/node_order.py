"""Bandwidth reduction: orders of keyframes with short edges; a closed loop folds into a band twice as wide.

The bandwidth of a matrix depends on the order of its rows. In time order an edge of a loop closure spans all of them.
Two other orders are tried, and the one with the shortest longest edge is used: reverse Cuthill-McKee (a breadth-first
search from a peripheral node), and the order of the Fiedler vector, the smoothest function on the graph (Barnard,
Pothen and Simon, "A spectral algorithm for envelope reduction of sparse matrices", 1995), which folds a ring exactly.
Cost: a few sparse solves; numpy and scipy, outside `jit`.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph
from scipy.sparse.linalg import eigsh

_MIN_NODES = 8
"""Minimum number of nodes for the spectral order; smaller graphs do not justify a sparse solve."""


def narrow_order(nodes: int, ends: np.ndarray) -> np.ndarray:
    """Return the position of each node, `int [n]`, in the order with the shortest longest edge.

    Args:
        nodes: number of nodes `n`.
        ends: int `[m, 2]`, the nodes of each edge.

    """
    graph = _adjacency(nodes, ends)
    tried = [np.arange(nodes), _cuthill_mckee(graph), *_spectral(graph)]
    # `min` keeps the first of equals, so the order of time stays unless another is narrower.
    return min(tried, key=lambda place: longest(place, ends))


def longest(place: np.ndarray, ends: np.ndarray) -> int:
    """Return the length of the longest edge in positions."""
    return int(np.abs(place[ends[:, 0]] - place[ends[:, 1]]).max(initial=0))


def _adjacency(nodes: int, ends: np.ndarray) -> sp.csr_matrix:
    both = np.concatenate([ends, ends[:, ::-1]])
    both = both[both[:, 0] != both[:, 1]]
    graph = sp.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(nodes, nodes))
    graph.data[:] = 1.0  # duplicate edges count once
    return graph


def _cuthill_mckee(graph: sp.csr_matrix) -> np.ndarray:
    return _places(csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True))


def _spectral(graph: sp.csr_matrix) -> list[np.ndarray]:
    """Return the orders of two spectral vectors; empty for a disconnected graph, where these are constant."""
    pieces, _ = csgraph.connected_components(graph, directed=False)
    if pieces > 1 or graph.shape[0] < _MIN_NODES:
        return []
    laplacian = csgraph.laplacian(graph).tocsc()
    # Shifted below zero, since the Laplacian is singular. A fixed start makes the order reproducible.
    start = np.cos(np.arange(graph.shape[0]))
    _, vectors = eigsh(laplacian, k=2, sigma=-1e-6, which="LM", v0=start)
    return [_places(np.argsort(vectors[:, column], kind="stable")) for column in range(2)]


def _places(order: np.ndarray) -> np.ndarray:
    """Return the inverse of a permutation."""
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    return place
