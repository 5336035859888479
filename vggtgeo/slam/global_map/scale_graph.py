"""Scale graph: the scale of each keyframe of a map without metric depth, from scale ratios measured by loops.

Scale is a homomorphism of the similarities, so the scale part of a Sim(3) pose graph is a linear graph of its own over
the logarithms of the scales. It is solved first, then the pose graph over SE(3) (`drift_correction.py`). This neglects
the information of motion lengths about scale, which is small around a loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.tracking.evidence import STEP_GROWTH

DRIFT = 0.01
"""Standard deviation of the change of scale from one keyframe to the next."""
GUESSED = STEP_GROWTH
"""The same if the length of the motion between them was taken from the motion so far."""
MIN_RATIO_ERROR = 0.03
"""Smallest standard deviation of the logarithm of a measured ratio: what its points have in common."""
WIDTHS = (1024.0, 256.0, 64.0, 16.0, 4.0, 2.5, 2.5, 2.5)
"""Widths of the Cauchy kernel on ratios, one reweighting each, in standard deviations: graduated, since after a large
drift true ratios have residuals as large as false ones."""


@dataclass(frozen=True)
class ScaleRatio:
    """Factor `ratio` that converts lengths of keyframe `second` to the scale of keyframe `first`; error: the standard
    error of its logarithm.
    """

    first: int
    second: int
    ratio: float
    error: float = 0.0


def solve_scales(keyframes: int, motions: Sequence[MeasuredRelativePose], ratios: Sequence[ScaleRatio]) -> np.ndarray:
    """Return the factor on the lengths of each keyframe, float64 [n]; that of the first is 1."""
    if not ratios:
        return np.ones(keyframes)
    ends = [*(motion.keyframes for motion in motions), *((r.first, r.second) for r in ratios)]
    first, second = np.array(ends, int).T
    measured = np.concatenate([np.zeros(len(motions)), np.log([r.ratio for r in ratios])])
    errors = [float(np.hypot(MIN_RATIO_ERROR, ratio.error)) for ratio in ratios]
    sigma = np.array([*(scale_drift(motion) for motion in motions), *errors])
    rows = np.repeat(np.arange(len(first)), 2)
    shape = (len(first), keyframes)
    logs, weight = np.zeros(keyframes), np.ones(len(first))
    for width in WIDTHS:
        values = np.tile([-1.0, 1.0], len(first)) * np.repeat(np.sqrt(weight) / sigma, 2)
        design = coo_array((values, (rows, np.stack([first, second], 1).ravel())), shape).tocsc()
        target = np.sqrt(weight) * measured / sigma
        # The weak hold of every logarithm at 0 decides for keyframes that nothing ties to the first.
        normal = design.T @ design + coo_array((np.full(keyframes, 1e-6), (np.arange(keyframes),) * 2)).tocsc()
        logs = np.asarray(spsolve(normal, design.T @ target))
        logs -= logs[0]
        residual = (logs[second] - logs[first] - measured) / sigma
        # Cauchy's weight, for the measured ratios only: nothing but them contradicts the drift model.
        weight[len(motions) :] = 1.0 / (1.0 + (residual[len(motions) :] / width) ** 2)
    return np.exp(logs)


def scale_drift(motion: MeasuredRelativePose) -> float:
    """Return the standard deviation of the change of scale along a tracked motion.

    Points triangulated by the motion inherit the relative error of its length.
    """
    if motion.by_rays:
        return GUESSED
    length = float(np.linalg.norm(motion.pose[:3, 3]))
    if not length > 0:
        return GUESSED
    along = motion.pose[:3, 3] / length
    sigma = float(np.sqrt(along @ np.linalg.inv(motion.information)[:3, :3] @ along))
    return min(math.hypot(DRIFT, sigma / length), GUESSED)
