"""Which linear solver suits a problem: decided outside `jit`, by its size and its graph."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.node_order import narrow_order
from vggtgeo.bundle.problem import Problem
from vggtgeo.bundle.terms.node import PairTerm
from vggtgeo.io.given import check_kind
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, BlockJacobi, ConjugateGradients
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced import AbstractReducedSolver, DenseCholesky

DENSE_LIMIT = 40
"""Keyframes up to which a dense factor costs no more than the linearisation before it."""
BAND_LIMIT = 24
"""Longest reach of a band: a group of `2 * 24` keyframes has 288 coordinates."""
MUCH_DENSE = 300
"""Keyframes above which a dense factor inside `jit` is worth a warning: at 200 an iteration takes twice as long as with
a band (docs/results/solver.md), and its cost grows with the cube."""
ORDERED_LIMIT = 12
"""Longest reach for which no other order is looked for, and the longest of a band that only preconditions."""
SHORT_SHARE = 0.5
"""Least share of edges that a band must hold to be worth factorising."""


def choose_reduced_solver(problem: Problem) -> AbstractReducedSolver:
    """A linear solver for `SchurLevenbergMarquardt(reduced_solver=...)`.

    Small problems and those with a marginalisation prior: dense Cholesky. Sequences, whose edges join keyframes near in
    their order, and closed loops, whose edges do so in a folded order: block-banded Cholesky, linear in the number of
    keyframes. Sequences with many loops: conjugate gradients with the band of their short edges as preconditioner. Any
    other graph: conjugate gradients with one block a keyframe.

    Args:
        problem: concrete arrays (not traced); the choice holds for every problem with the same graph.

    Example: a window is small.
        >>> vg.choose_reduced_solver(problem)
        DenseCholesky()

    """
    check_kind("problem", problem, Problem, "a `Problem`, the first of what `vggtgeo.pack` gives")
    if problem.num_keyframes <= DENSE_LIMIT or problem.dense_terms:
        return DenseCholesky()
    ends, alone = coupled_pairs(problem)
    lengths = _reaches(np.arange(problem.num_keyframes), ends, alone)
    reach = int(lengths.max(initial=1))
    if reach <= ORDERED_LIMIT:
        return BandCholesky(reach)
    place = narrow_order(problem.num_keyframes, ends)
    folded = int(_reaches(place, ends, alone).max(initial=1))
    if min(folded, reach) <= BAND_LIMIT:
        return BandCholesky(folded, jnp.asarray(place)) if folded < reach else BandCholesky(reach)
    short = lengths[lengths <= ORDERED_LIMIT]
    if len(short) < SHORT_SHARE * len(lengths):
        return ConjugateGradients(BlockJacobi())
    return ConjugateGradients(BandPreconditioner(int(short.max(initial=1))))


def default_solver(problem: Problem) -> SchurLevenbergMarquardt:
    """What `solve` takes without a word: the linear solver that suits the graph, or inside `jit`, where the graph
    cannot be looked at, the dense one, with a warning where that is slow.
    """
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(problem)):
        with jax.ensure_compile_time_eval():  # arrays that a jitted function closes over have values, too
            return SchurLevenbergMarquardt(reduced_solver=choose_reduced_solver(problem))
    if problem.num_keyframes > MUCH_DENSE and not problem.dense_terms:
        warnings.warn(
            f"`solve` of {problem.num_keyframes} keyframes inside `jit` takes a dense linear solver, for the graph "
            "cannot be looked at there: choose one outside, `solver=SchurLevenbergMarquardt(reduced_solver="
            "choose_reduced_solver(problem))`",
            stacklevel=3,
        )
    return SchurLevenbergMarquardt()


def coupled_pairs(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Nodes of every edge that observes anything and of every pair, `int [m, 2]`, and which of them are pairs alone.

    Two keyframes that one host sees are coupled through its landmarks, so a band of reach `r` holds blocks `2 r` apart,
    and a pair, which no landmark takes part in, may be twice as long as an edge.
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
    """The reach that each pair of nodes asks of a band in that order."""
    apart = np.abs(place[ends[:, 0]] - place[ends[:, 1]])
    return np.where(alone, (apart + 1) // 2, apart)
