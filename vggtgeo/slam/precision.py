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
    """

    @wraps(function)
    def wrapped(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return wrapped
