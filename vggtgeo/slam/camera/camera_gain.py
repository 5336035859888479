"""Test whether another camera explains the matches significantly better."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import t as student_t

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residuals import residuals_at
from vggtgeo.compilation.program_cache import CachedProgram

CHANCE = 1e-3
"""Significance level of the test."""
MIN_HOSTS = 3


def _energies(problem: Problem, state: State) -> Float[Array, "e p"]:
    residual = residuals_at(problem, state)["points"]
    return problem.points.kernel.rho(problem.points.weight * jnp.sum(residual**2, -1)) / 2


_energies_jit = CachedProgram(_energies, lambda problem, state: problem.points.weight)


def gain(
    before: tuple[Problem, State], after: tuple[Problem, State], chosen: np.ndarray, fitted: int = 0
) -> tuple[float, float]:
    """Return the mean decrease of a match's robust energy, and the decrease that is significant at `CHANCE`.

    Student's t over keyframes, because the matches of one share a pose; at least the standard error over matches.

    before, after: the same map adjusted with either camera. chosen: bool [e, p], the matches to use. fitted: number of
    camera parameters fitted to these matches; each takes one degree of freedom.
    """
    fall = np.where(chosen, match_energies(*before) - match_energies(*after), 0.0)
    problem = before[0]
    source = np.asarray(problem.edges.source)
    sums, counts = np.zeros(problem.num_keyframes), np.zeros(problem.num_keyframes)
    np.add.at(sums, source, fall.sum(1))
    np.add.at(counts, source, chosen.sum(1))
    total, hosts = counts.sum(), np.count_nonzero(counts)
    free = hosts - max(fitted, 1)
    if hosts < MIN_HOSTS or free < 1:
        return 0.0, float("inf")
    mean = sums.sum() / total
    by_keyframe = np.sqrt(hosts / free * np.sum((sums - mean * counts) ** 2)) / total
    by_match = np.sqrt(np.sum((fall[chosen] - mean) ** 2)) / total
    return float(mean), float(student_t.isf(CHANCE, free) * max(by_keyframe, by_match))


def match_energies(problem: Problem, state: State) -> np.ndarray:
    """Return the robust energy of each match of key points, float64 [e, p]."""
    return np.asarray(_energies_jit(problem, state), np.float64)
