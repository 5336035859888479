"""Absolute trajectory error (ATE): distance of the camera centres from the ground truth after alignment.

Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float

from vggtgeo.evaluation.alignment import VERTICAL, Alignment, Similarity, align
from vggtgeo.evaluation.association import check_trajectories
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of `count` non-negative errors, in their unit; NaN if there are none."""

    rmse: float
    mean: float
    median: float
    maximum: float
    count: int

    @classmethod
    def of(cls, errors: Float[np.ndarray, " n"]) -> Self:
        """Return the statistics of `errors` [n]."""
        if len(errors) == 0:
            return cls(np.nan, np.nan, np.nan, np.nan, 0)
        rmse = float(np.sqrt(np.mean(np.square(errors))))
        return cls(rmse, float(errors.mean()), float(np.median(errors)), float(errors.max()), len(errors))


@dataclass(frozen=True, eq=False)
class AbsoluteError:
    """Fields: errors float64 [n], metres, one per pose; alignment of the estimate to the ground truth."""

    errors: Float[np.ndarray, " n"]
    alignment: Similarity

    @property
    def statistics(self) -> ErrorStatistics:
        """Statistics of the errors, metres; `rmse` is the ATE."""
        return ErrorStatistics.of(self.errors)


def absolute_error(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment = "se3",
    vertical: tuple[float, float, float] = VERTICAL,
) -> AbsoluteError:
    """Return the ATE of matched trajectories (see `associate`) after an `alignment` (see `align`).

    InputError if the lengths differ.
    """
    check_trajectories(estimate, truth)
    if len(estimate) != len(truth):
        raise InputError(
            f"`estimate` has {len(estimate)} poses, `truth` {len(truth)}; match them first with `associate`"
        )
    motion = align(estimate, truth, alignment, vertical)
    difference = motion.points(estimate.positions) - truth.positions
    return AbsoluteError(np.linalg.norm(difference, axis=1), motion)
