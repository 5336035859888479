"""Matches moved to where an ideal camera would see them: of a global shutter, without lens distortion.

The adjustment of a map then stays that of a pinhole, and its compiled program the same.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.problem import Problem, State


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
    there = np.einsum("aij,abj->abi", relative[:, :3, :3], rays(pixels, camera))
    there += relative[:, None, :3, 3] * inverse[..., None]
    with np.errstate(all="ignore"):
        return there[..., :2] / there[..., 2:] * camera[:2] + camera[2:], inverse / there[..., 2]


def rays(pixels: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Return rays with depth one, [..., 3]."""
    return np.concatenate([(pixels - camera[2:]) / camera[:2], np.ones((*pixels.shape[:-1], 1))], -1)


def shifted_problem(problem: Problem, shifts: Shifts, factor: float, most: float) -> Problem:
    """Return the problem with `factor` times the shifts subtracted from its pixels. most: largest displacement, pixels:
    larger ones come from landmarks at the camera's centre, or from a distortion that folds the image.
    """
    slots, points, lines = (np.clip(factor * shift, -most, most) for shift in shifts)
    coefficients = np.asarray(problem.lines.coefficients, np.float64)
    offset = coefficients[..., 2] + np.sum(coefficients[..., :2] * lines, -1)
    like = lambda values: jnp.asarray(values, problem.pixels.dtype)
    return eqx.tree_at(
        lambda p: (p.pixels, p.points.target, p.lines.coefficients),
        problem,
        (
            like(np.asarray(problem.pixels) - slots),
            like(np.asarray(problem.points.target) - points),
            like(np.concatenate([coefficients[..., :2], offset[..., None]], -1)),
        ),
    )
