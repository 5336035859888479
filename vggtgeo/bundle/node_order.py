"""Orders of keyframes that keep the edges of a graph short: a closed loop folds into a band twice as wide.

The band of a matrix is a matter of the order of its rows. In the order of time an edge that closes a loop reaches over
all of them. Two orders are tried besides that one, and the shortest longest edge wins: reverse Cuthill-McKee (a breadth
first search from a peripheral node), and the order of the Fiedler vector, the smoothest function on the graph (Barnard,
Pothen and Simon, "A spectral algorithm for envelope reduction of sparse matrices", 1995), which folds a ring exactly.
Cost: that of a few sparse solves; numpy and scipy, outside `jit`.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph
from scipy.sparse.linalg import eigsh

_LEAST = 8
"""Nodes below which the eigenvector is not worth a sparse solve."""


def narrow_order(nodes: int, ends: np.ndarray) -> np.ndarray:
    """Place of each node, `int [n]`, in the order of the shortest longest edge among those tried.

    Args:
        nodes: their number `n`.
        ends: int `[m, 2]`, the nodes of each edge.

    """
    graph = _adjacency(nodes, ends)
    tried = [np.arange(nodes), _cuthill_mckee(graph), *_spectral(graph)]
    return min(tried, key=lambda place: longest(place, ends))


def longest(place: np.ndarray, ends: np.ndarray) -> int:
    """Places between the ends of the longest edge."""
    return int(np.abs(place[ends[:, 0]] - place[ends[:, 1]]).max(initial=0))


def _adjacency(nodes: int, ends: np.ndarray) -> sp.csr_matrix:
    both = np.concatenate([ends, ends[:, ::-1]])
    both = both[both[:, 0] != both[:, 1]]
    graph = sp.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(nodes, nodes))
    graph.data[:] = 1.0  # an edge given twice counts once
    return graph


def _cuthill_mckee(graph: sp.csr_matrix) -> np.ndarray:
    return _places(csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True))


def _spectral(graph: sp.csr_matrix) -> list[np.ndarray]:
    """The order of the Fiedler vector; none for a graph in pieces, whose smoothest functions are constant on them."""
    pieces, _ = csgraph.connected_components(graph, directed=False)
    if pieces > 1 or graph.shape[0] < _LEAST:
        return []
    laplacian = csgraph.laplacian(graph).tocsc()
    # Shifted below zero: the Laplacian itself is singular. A fixed start makes the order the same every time.
    start = np.cos(np.arange(graph.shape[0]))
    _, vectors = eigsh(laplacian, k=2, sigma=-1e-6, which="LM", v0=start)
    return [_places(np.argsort(vectors[:, column], kind="stable")) for column in range(2)]


def _places(order: np.ndarray) -> np.ndarray:
    """The inverse of a permutation."""
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    return place
