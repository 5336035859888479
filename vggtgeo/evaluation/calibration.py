"""How far estimated intrinsics and an estimated scale are off."""

import math

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_real, real_array


def focal_error(estimated: tuple[float, float, float, float], true: tuple[float, float, float, float]) -> float:
    """Relative error of the focal length: the mean of `fx / fx_true` and `fy / fy_true`, less 1; signed.

    Both are fx, fy, cx, cy in pixels. InputError where a focal length is not positive.
    """
    for name, given in (("estimated", estimated), ("true", true)):
        values = real_array(name, given, (4,))
        if not (math.isfinite(values[0] * values[1]) and min(values[:2]) > 0):
            raise InputError(f"`{name}` has focal lengths {values[0]} and {values[1]}; both must be positive")
    return 0.5 * (estimated[0] / true[0] + estimated[1] / true[1]) - 1.0


def scale_error(scale: float) -> float:
    """Relative error of lengths, signed, where `scale` is what a Sim(3) alignment multiplies the estimate by.

    An estimate that is 2 % too large has scale 1 / 1.02 and an error of 0.02. InputError where it is not positive.
    """
    check_real("scale", scale, "positive")
    if not (scale > 0 and math.isfinite(scale) and math.isfinite(1.0 / scale)):
        raise InputError(f"`scale` is {scale}; it must be positive")
    return 1.0 / scale - 1.0
