"""Absolute trajectory error (ATE): how far the camera centres are from the truth after one alignment.

Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vggtgeo.evaluation.alignment import Similarity, umeyama
from vggtgeo.evaluation.statistics import ErrorStatistics
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class AbsoluteError:
    """Fields: errors float64 [n], metres, a pose each; alignment, which carried the estimate to the truth."""

    errors: Float[np.ndarray, " n"]
    alignment: Similarity

    @property
    def statistics(self) -> ErrorStatistics:
        """In metres; `rmse` is what the field calls ATE."""
        return ErrorStatistics.of(self.errors)


def absolute_error(estimate: Trajectory, truth: Trajectory, with_scale: bool = False) -> AbsoluteError:
    """ATE of matched trajectories (see `associate`) after SE(3) alignment, or Sim(3) `with_scale`.

    InputError where the two differ in length.
    """
    if len(estimate) != len(truth):
        raise InputError(
            f"`estimate` has {len(estimate)} poses, `truth` {len(truth)}; match them first with `associate`"
        )
    alignment = umeyama(estimate.positions, truth.positions, with_scale)
    difference = alignment.points(estimate.positions) - truth.positions
    return AbsoluteError(np.linalg.norm(difference, axis=1), alignment)
