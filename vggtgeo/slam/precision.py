"""Floating-point precision of the pipeline, independent of the caller's JAX configuration."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def in_double_precision(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Run `function` with JAX's 64-bit types enabled; the caller's setting is restored.

    The prior of marginalised keyframes is a product of many solves. In single precision its weakest directions (scale,
    drift) are lost in the rounding errors of its strongest.

    The caller's debugging options are disabled as well: here NaN means unknown, compiled programs cannot run line by
    line, and types are mixed.
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
