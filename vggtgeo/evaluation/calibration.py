"""Relative errors of estimated focal lengths and of an estimated scale."""

import math

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_real, real_array


def focal_error(estimated: tuple[float, float, float, float], true: tuple[float, float, float, float]) -> float:
    """Return the signed relative error of the focal length: the mean of `fx / fx_true` and `fy / fy_true`, minus 1.

    Both arguments are fx, fy, cx, cy in pixels. InputError if a focal length is not positive.
    """
    for name, given in (("estimated", estimated), ("true", true)):
        values = real_array(name, given, (4,))
        if not (math.isfinite(values[0] * values[1]) and min(values[:2]) > 0):
            raise InputError(f"`{name}` must have positive focal lengths, got {values[0]} and {values[1]}")
    return 0.5 * (estimated[0] / true[0] + estimated[1] / true[1]) - 1.0


def scale_error(scale: float) -> float:
    """Return the signed relative error of lengths for the `scale` of a Sim(3) alignment of the estimate.

    An estimate that is 2 % too large has scale 1 / 1.02 and error 0.02. InputError if `scale` is not positive.
    """
    check_real("scale", scale, "positive")
    if not (scale > 0 and math.isfinite(scale) and math.isfinite(1.0 / scale)):
        raise InputError(f"`scale` must be positive, got {scale}")
    return 1.0 / scale - 1.0
