"""Choice of the linear solver for a problem, by its size and its graph; numpy and scipy, outside `jit`.

The bandwidth of a matrix depends on the order of its rows. In time order an edge of a loop closure spans all of them.
Two other orders are tried, and the one with the shortest longest edge is used: reverse Cuthill-McKee (a breadth-first
search from a peripheral node), and the order of the Fiedler vector, the smoothest function on the graph (Barnard,
Pothen and Simon, "A spectral algorithm for envelope reduction of sparse matrices", 1995), which folds a ring exactly.
Cost: a few sparse solves.
"""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph
from scipy.sparse.linalg import eigsh

from vggtgeo.bundle.problem import Problem
from vggtgeo.bundle.terms.node import PairTerm
from vggtgeo.io.argument_checks import check_kind
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, BlockJacobi, ConjugateGradients
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky

DENSE_LIMIT = 40
"""Number of keyframes up to which a dense factor costs no more than the linearisation."""
BAND_LIMIT = 24
"""Maximum reach of a band: a group of `2 * 24` keyframes has 288 coordinates."""
DENSE_WARNING = 300
"""Number of keyframes above which a dense factor inside `jit` causes a warning: at 200 an iteration takes twice as long
as with a band (docs/results/solver.md), and its cost grows with the cube."""
ORDERED_LIMIT = 12
"""Maximum reach for which the order of keyframes is kept, and of a band used as preconditioner."""
SHORT_SHARE = 0.5
"""Minimum share of edges inside a band for the band to be a useful preconditioner."""
_MIN_NODES = 8
"""Minimum number of nodes for the spectral order; smaller graphs do not justify a sparse solve."""


def choose_reduced_solver(problem: Problem) -> AbstractReducedSolver:
    """Choose a linear solver for `SchurLevenbergMarquardt(reduced_solver=...)`.

    Small problems and those with a marginalisation prior: dense Cholesky. Sequences, whose edges join keyframes near in
    order, and closed loops, whose edges do so in a folded order: block-banded Cholesky, linear in the number of
    keyframes. Sequences with many loops: conjugate gradients with the band of short edges as preconditioner. Any other
    graph: conjugate gradients with one block for each keyframe.

    Args:
        problem: concrete arrays (not traced); the choice is valid for every problem with the same graph.

    Example: a window is small.
        >>> vg.choose_reduced_solver(problem)
        DenseCholesky()

    """
    check_kind("problem", problem, Problem, "a `Problem`, the first result of `vggtgeo.pack`")
    if problem.num_keyframes <= DENSE_LIMIT or problem.dense_terms:
        return DenseCholesky()
    ends, alone = coupled_pairs(problem)
    lengths = _reaches(np.arange(problem.num_keyframes), ends, alone)
    reach = int(lengths.max(initial=1))
    if reach <= ORDERED_LIMIT:
        return BandCholesky(reach)
    # A closed loop has one long edge in time order, and none in a folded one.
    place = narrow_order(problem.num_keyframes, ends)
    folded = int(_reaches(place, ends, alone).max(initial=1))
    if min(folded, reach) <= BAND_LIMIT:
        return BandCholesky(folded, jnp.asarray(place)) if folded < reach else BandCholesky(reach)
    short = lengths[lengths <= ORDERED_LIMIT]
    if len(short) < SHORT_SHARE * len(lengths):
        return ConjugateGradients(BlockJacobi())
    return ConjugateGradients(BandPreconditioner(int(short.max(initial=1))))


def default_solver(problem: Problem) -> SchurLevenbergMarquardt:
    """Return the default solver: linear solver chosen from the graph; inside `jit` dense, with a warning if slow."""
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(problem)):
        with jax.ensure_compile_time_eval():  # arrays that a jitted function closes over have values, too
            return SchurLevenbergMarquardt(reduced_solver=choose_reduced_solver(problem))
    if problem.num_keyframes > DENSE_WARNING and not problem.dense_terms:
        warnings.warn(
            f"`solve` of {problem.num_keyframes} keyframes inside `jit` uses a dense linear solver, since the graph is "
            "traced there: choose one outside, `solver=SchurLevenbergMarquardt(reduced_solver="
            "choose_reduced_solver(problem))`",
            stacklevel=3,
        )
    return SchurLevenbergMarquardt()


def coupled_pairs(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of every edge with observations and of every pair, `int [m, 2]`, and which are only pairs.

    Two keyframes observed from one host are coupled through its landmarks, so a band of reach `r` has blocks `2 r`
    apart. A pair has no landmarks, so it may be twice as long as an edge.
    """
    seen = np.zeros(len(problem.edges.source), bool)
    for term in problem.edge_terms:
        seen |= np.any(np.asarray(term.present()), 1)
    ends = [np.stack([np.asarray(problem.edges.source), np.asarray(problem.edges.target)], 1)[seen]]
    for pair in problem.node_terms:
        if isinstance(pair, PairTerm):
            ends.append(np.stack([np.asarray(pair.first), np.asarray(pair.second)], 1)[np.asarray(pair.present())])
    alone = np.repeat([False, *[True] * (len(ends) - 1)], [len(own) for own in ends])
    return np.concatenate(ends), alone


def _reaches(place: np.ndarray, ends: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Return the reach of a band that each pair of nodes needs in that order."""
    apart = np.abs(place[ends[:, 0]] - place[ends[:, 1]])
    # Edges couple nodes up to twice their length apart (see `coupled_pairs`), pairs only their own ends.
    return np.where(alone, (apart + 1) // 2, apart)


def narrow_order(nodes: int, ends: np.ndarray) -> np.ndarray:
    """Return the position of each node, `int [n]`, in the order with the shortest longest edge.

    Args:
        nodes: number of nodes `n`.
        ends: int `[m, 2]`, the nodes of each edge.

    """
    graph = _adjacency(nodes, ends)
    folded = _places(csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True))
    tried = [np.arange(nodes), folded, *_spectral(graph)]
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
