"""Small rigid motions in numpy, for estimators that improve a pose step by step."""

from __future__ import annotations

import math

import numpy as np


def exponential(tangent: np.ndarray) -> np.ndarray:
    """The motion [4, 4] of a translation and a rotation vector, float64 [6]: Exp on R^3 x SO(3), to first order that of
    SE(3), and as good a retraction.

    By Rodrigues' formula in Python's own numbers: a call that lets other threads run, as OpenCV's do, may wait for them
    sixty times as long as it takes.
    """
    tx, ty, tz, x, y, z = map(float, tangent)
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    # sin(a) / a and (1 - cos(a)) / a^2; by their series where the second would cancel.
    along = math.sin(angle) / angle if angle > 1e-4 else 1 - square / 6
    bend = (1 - math.cos(angle)) / square if angle > 1e-4 else 0.5 - square / 24
    return np.array(
        [
            [1 - bend * (y * y + z * z), bend * x * y - along * z, bend * x * z + along * y, tx],
            [bend * x * y + along * z, 1 - bend * (x * x + z * z), bend * y * z - along * x, ty],
            [bend * x * z - along * y, bend * y * z + along * x, 1 - bend * (x * x + y * y), tz],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
