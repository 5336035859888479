"""Compare another camera with that of an adjusted map: move the matches to it, and test whether it explains them.

Matches are moved to where an ideal camera would see them: of a global shutter, without lens distortion. The adjustment
of the map then stays that of a pinhole, and its compiled program the same. The test asks whether the robust energy of
the matches decreases significantly.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import stdtrit

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residual_values import residuals_at
from vggtgeo.compilation.program_cache import CachedProgram
from vggtgeo.geometry import pinhole

CHANCE = 1e-3
"""Significance level of the test."""
MIN_HOSTS = 3
"""Minimum number of hosts of landmarks: the variance of fewer sums cannot be estimated."""


class Shifts(NamedTuple):
    """Displacements of a problem's pixels: of slots [n, s, 2], of points [e, p, 2] in the target, and of lines
    [e, l, 2] at their projected samples. In pixels, or in pixels a unit of some parameter.
    """

    slots: np.ndarray
    points: np.ndarray
    lines: np.ndarray


def pinhole_of(problem: Problem, state: State) -> np.ndarray:
    """Return fx, fy, cx, cy."""
    parameters = np.asarray(state.intrinsics, np.float64)
    return np.array([parameters[0], *parameters])[:4] if problem.shared_focal else parameters[:4]


def carried(
    pixels: np.ndarray, inverse: np.ndarray, relative: np.ndarray, camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels [a, b, 2] and inverse depths [a, b] of landmarks in other cameras; relative: [a, 4, 4]."""
    there = np.einsum("aij,abj->abi", relative[:, :3, :3], pinhole.rays(pixels, camera))
    there += relative[:, None, :3, 3] * inverse[..., None]
    with np.errstate(all="ignore"):
        return there[..., :2] / there[..., 2:] * camera[:2] + camera[2:], inverse / there[..., 2]


def shifted_problem(problem: Problem, shifts: Shifts, factor: float, most: float) -> Problem:
    """Return the problem with `factor` times the shifts subtracted from its pixels. most: largest displacement, pixels:
    larger ones come from landmarks at the camera's centre, or from a distortion that folds the image.
    """
    slots, points, lines = (np.clip(factor * shift, -most, most) for shift in shifts)
    coefficients = np.asarray(problem.terms["lines"].coefficients, np.float64)
    offset = coefficients[..., 2] + np.sum(coefficients[..., :2] * lines, -1)
    like = lambda values: jnp.asarray(values, problem.pixels.dtype)
    return eqx.tree_at(
        lambda p: (p.pixels, p.terms["points"].target, p.terms["lines"].coefficients),
        problem,
        (
            like(np.asarray(problem.pixels) - slots),
            like(np.asarray(problem.terms["points"].target) - points),
            like(np.concatenate([coefficients[..., :2], offset[..., None]], -1)),
        ),
    )


def _energies(problem: Problem, state: State) -> Float[Array, "e p"]:
    residual = residuals_at(problem, state)["points"]
    return problem.terms["points"].kernel.rho(problem.terms["points"].weight * jnp.sum(residual**2, -1)) / 2


_energies_jit = CachedProgram(_energies, lambda problem, state: problem.terms["points"].weight)


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
    return float(mean), float(-stdtrit(free, CHANCE) * max(by_keyframe, by_match))


def match_energies(problem: Problem, state: State) -> np.ndarray:
    """Return the robust energy of each match of key points, float64 [e, p]."""
    return np.asarray(_energies_jit(problem, state), np.float64)
