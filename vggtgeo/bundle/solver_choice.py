"""Which linear solver suits a problem: decided outside `jit`, by its size and its graph."""

from __future__ import annotations

import numpy as np

from vggtgeo.bundle.problem import Problem
from vggtgeo.bundle.terms.node import PairTerm
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, BlockJacobi, ConjugateGradients
from vggtgeo.solvers.reduced import AbstractReducedSolver, DenseCholesky

DENSE_LIMIT = 40
"""Keyframes up to which a dense factor costs no more than the linearisation before it."""
BAND_LIMIT = 12
"""Longest reach of a band: a group of `2 * 12` keyframes has 144 coordinates."""
SHORT_SHARE = 0.5
"""Least share of edges that a band must hold to be worth factorising."""


def choose_reduced_solver(problem: Problem) -> AbstractReducedSolver:
    """A linear solver for `SchurLevenbergMarquardt(reduced_solver=...)`.

    Small problems and those with a marginalisation prior: dense Cholesky. Sequences, whose edges join keyframes near in
    their order: block-banded Cholesky, linear in the number of keyframes. Sequences with closed loops: conjugate
    gradients with the band as their preconditioner. Any other graph: conjugate gradients with one block a keyframe.

    Args:
        problem: concrete arrays (not traced); the choice holds for every problem with the same graph.

    Example: a window is small.
        >>> vg.choose_reduced_solver(problem)
        DenseCholesky()

    """
    if problem.num_keyframes <= DENSE_LIMIT or problem.dense_terms:
        return DenseCholesky()
    lengths = edge_lengths(problem)
    reach = int(lengths.max(initial=1))
    if reach <= BAND_LIMIT:
        return BandCholesky(reach)
    short = lengths[lengths <= BAND_LIMIT]
    if len(short) < SHORT_SHARE * len(lengths):
        return ConjugateGradients(BlockJacobi())
    return ConjugateGradients(BandPreconditioner(int(short.max(initial=1))))


def edge_lengths(problem: Problem) -> np.ndarray:
    """`|i - j|` of every edge that observes anything, and half that of every pair (a band of reach `r` holds blocks
    `2 r` apart), `int[e']`.
    """
    seen = np.zeros(len(problem.edges.source), bool)
    for term in problem.edge_terms:
        seen |= np.any(np.asarray(term.present()), 1)
    lengths = [np.abs(np.asarray(problem.edges.source) - np.asarray(problem.edges.target))[seen]]
    for pair in problem.node_terms:
        if isinstance(pair, PairTerm):
            apart = np.abs(np.asarray(pair.first) - np.asarray(pair.second))[np.asarray(pair.present())]
            lengths.append((apart + 1) // 2)
    return np.concatenate(lengths)
