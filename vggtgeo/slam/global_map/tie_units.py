"""Tracked motions of a map of free scale in the unit that the map has where they are.

A motion is tracked in the unit of its moment, which drifts: by `DRIFT` from one keyframe to the next, by `GUESSED`
where its length was taken from the motion so far. So the logarithms of the units are a random walk, and the adjusted
poses measure each to within `FREE_LENGTH`. Taken at their word, lengths of many motions would hold the drift: the last
adjustment of building-walk, begun at the true poses, ended 25 cm off. In turns, poses given units and units given
poses, both come to the optimum of the two together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solveh_banded

from vggtgeo.geometry import rigid
from vggtgeo.slam.global_map.unit_graph import DRIFT, GUESSED
from vggtgeo.slam.sparse_map.factors import FREE_LENGTH, Factor, MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.units import scaled_motion


def in_local_units(factors: Sequence[Factor], keyframes: Sequence[Keyframe]) -> tuple[Factor, ...]:
    """The factors, tracked motions as long as the unit where they are says; what was recorded stays."""
    rows = [
        row
        for row, factor in enumerate(factors)
        if isinstance(factor, MeasuredRelativePose) and not factor.recorded and _lengths(factor, keyframes).all()
    ]
    ties = [factor for row in rows if isinstance(factor := factors[row], MeasuredRelativePose)]
    if not ties:
        return tuple(factors)
    units = np.exp(local_units(ties, keyframes))
    changed = {row: scaled_motion(tie, float(unit)) for row, tie, unit in zip(rows, ties, units, strict=True)}
    return tuple(changed.get(row, factor) for row, factor in enumerate(factors))


def local_units(ties: Sequence[MeasuredRelativePose], keyframes: Sequence[Keyframe]) -> np.ndarray:
    """Logarithm of the unit of each motion, float64 [n]: of how long the poses have it over how long it was tracked,
    smoothed in the order of the motions.
    """
    logs = np.array([np.log(np.divide(*_lengths(tie, keyframes))) for tie in ties])
    order = np.argsort([tie.second for tie in ties], kind="stable")
    guessed = np.array([tie.by_rays for tie in ties])[order]
    known = 1 / np.where(guessed, GUESSED, FREE_LENGTH) ** 2
    # A guessed length parts the units before and after it.
    step = 1 / np.where(guessed[1:] | guessed[:-1], GUESSED, DRIFT) ** 2
    banded = np.zeros((2, len(ties)))
    banded[1] = known
    banded[1, 1:] += step
    banded[1, :-1] += step
    banded[0, 1:] = -step
    units = np.zeros(len(ties))
    units[order] = solveh_banded(banded, known * logs[order])
    return units


def _lengths(tie: MeasuredRelativePose, keyframes: Sequence[Keyframe]) -> np.ndarray:
    """Of the motion by the poses, and as tracked, float64 [2]."""
    first, second = (keyframes[number].pose for number in tie.keyframes)
    return np.array([np.linalg.norm((second @ rigid.invert(first))[:3, 3]), np.linalg.norm(tie.pose[:3, 3])])
