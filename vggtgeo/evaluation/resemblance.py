"""Whether an estimate and a truth are of one sequence at all.

Times alone do not tell: most sequences begin at zero and have 30 frames a second. Nor does the ATE, which an alignment
of two straight walks makes small. Rotations do: over a tenth of the sequence, an estimate of the same camera has less
error than the camera has motion, and one of another camera has more, sqrt(2) times as much if the two move alike.
"""

import warnings

import numpy as np

from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate
from vggtgeo.evaluation.relative import relative_error, rotation_angle
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputWarning

LEAST_TURN = np.radians(2.0)
"""RMS rotation of the truth below which nothing can be said."""
FEW = 0.5
"""Share of the poses of the shorter trajectory that should have a partner in time."""


def warn_of_strangers(estimate: Trajectory, truth: Trajectory, max_dt: float = MAX_TIME_DIFFERENCE) -> None:
    """An InputWarning where few poses match in time, and where the rotations have nothing to do with each other."""
    matched, reference = associate(estimate, truth, max_dt)
    shorter = min(len(estimate), len(truth))
    if len(matched) < FEW * shorter:
        warnings.warn(
            f"only {len(matched)} of {shorter} poses match within {max_dt:g} s: are both of one sequence?",
            InputWarning,
            stacklevel=2,
        )
    ratio = rotation_misfit(matched, reference)
    if ratio is not None and ratio >= 1.0:
        warnings.warn(
            f"the estimate explains the true rotations no better than a camera that stands still (error / motion "
            f"{ratio:.2f}): it is of another sequence, or it failed",
            InputWarning,
            stacklevel=2,
        )


def rotation_misfit(matched: Trajectory, reference: Trajectory) -> float | None:
    """RMS rotation error over RMS rotation of the truth, over pairs a tenth of the sequence apart; None where the
    camera hardly turns.
    """
    delta = max(len(matched) // 10, 1)
    if len(matched) <= delta:
        return None
    first = np.arange(len(matched) - delta)
    turned = rotation_angle(reference.rotations[first].swapaxes(1, 2) @ reference.rotations[first + delta])
    motion = float(np.sqrt(np.mean(turned**2)))
    if motion < LEAST_TURN:
        return None
    error = relative_error(matched, reference, delta, all_pairs=True).rotation
    return float(np.sqrt(np.mean(error**2))) / motion
