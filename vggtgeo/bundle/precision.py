"""Range of the precision of a problem: finite numbers must not overflow, and positive numbers must not underflow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from vggtgeo.io.errors import InputError


def check_precision(given: Mapping[str, Any], dtype: DTypeLike | None, positive: tuple[str, ...] = ()) -> None:
    """Check that numbers are in the range of `dtype` (None: JAX's default), and those in `positive` not zero in it.

    Raises:
        InputError: a number is out of range; the message has its position and the range.

    """
    dtype = jnp.result_type(float) if dtype is None else dtype
    limits = jnp.finfo(dtype)
    largest, smallest = float(limits.max), float(limits.tiny)
    for name, values in given.items():
        if isinstance(values, jax.core.Tracer):
            continue
        found = np.asarray(values)
        if found.dtype.kind != "f":
            continue
        # In double precision, since half precision could not hold the limits.
        size = np.abs(found, dtype=np.promote_types(found.dtype, np.float64))
        wrong = np.isfinite(size) & (size > largest)
        if name in positive:
            wrong |= (size > 0) & (size < smallest)
        if np.any(wrong):
            place = tuple(map(int, np.unravel_index(int(np.argmax(wrong)), wrong.shape)))
            where = f"[{', '.join(map(str, place))}]" if place else ""
            raise InputError(
                f"`{name}{where}` must be from {smallest:.2g} to {largest:.2g}, the range of {jnp.dtype(dtype)}, got "
                f"{found[place]}: use another unit, or double precision"
            )


def weight_of(name: str, sigma: Any, dtype: DTypeLike) -> Any:
    """Return `1 / sigma^2` of the argument `name`; 0 if `sigma^2` overflows.

    Raises:
        InputError: `sigma` is so small that the weight is infinite.

    """
    with np.errstate(over="ignore", divide="ignore"):
        weight = 1 / np.square(np.asarray(sigma, np.float64))
    if not np.all(weight <= float(jnp.finfo(dtype).max)):
        raise InputError(
            f"`{name}` must be so large that 1 / sigma^2 is finite in {jnp.dtype(dtype)}, got {sigma}: use a larger "
            "one, or `fixed_intrinsics` for exact values"
        )
    return weight
