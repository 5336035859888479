"""The pipeline's own floating-point precision, whatever the caller has set for JAX."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def in_double_precision(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Run `function` with JAX's 64-bit types switched on, as they are in the program; the caller's switch stays.

    The prior of the keyframes that have left is a product of many solves, and in single precision its weakest
    directions (scale, drift) are lost in the rounding of its strongest.

    What callers set to find faults of their own is off as well: here NaN means none, compiled programs are called that
    cannot be run line by line, and types are mixed.
    """

    @wraps(function)
    def wrapped(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        with (
            jax.enable_x64(True),
            jax.numpy_dtype_promotion("standard"),
            jax.debug_nans(False),
            jax.debug_infs(False),
            jax.disable_jit(False),
        ):
            return function(*args, **kwargs)

    return wrapped
