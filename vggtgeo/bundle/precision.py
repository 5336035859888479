"""What the precision of a problem can hold: a finite number given must not become infinite, or a positive one zero."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from vggtgeo.io.errors import InputError


def check_precision(given: Mapping[str, Any], dtype: DTypeLike | None, positive: tuple[str, ...] = ()) -> None:
    """Refuse numbers beyond those of `dtype` (None: JAX's own type), and of `positive` names those that are zero there.

    Raises:
        InputError: names the first such number, and the range that there is.

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
        size = np.abs(found, dtype=np.promote_types(found.dtype, np.float64))
        wrong = np.isfinite(size) & (size > largest)
        if name in positive:
            wrong |= (size > 0) & (size < smallest)
        if np.any(wrong):
            place = tuple(map(int, np.unravel_index(int(np.argmax(wrong)), wrong.shape)))
            where = f"[{', '.join(map(str, place))}]" if place else ""
            raise InputError(
                f"`{name}{where}` is {found[place]}; {jnp.dtype(dtype)} holds numbers from {smallest:.2g} to "
                f"{largest:.2g}: give another unit, or double precision"
            )


def weight_of(name: str, sigma: Any, dtype: DTypeLike) -> Any:
    """`1 / sigma^2` of the argument `name`; a deviation so large that its square is no number weighs nothing.

    Raises:
        InputError: a deviation so small that its weight is infinite.

    """
    with np.errstate(over="ignore", divide="ignore"):
        weight = 1 / np.square(np.asarray(sigma, np.float64))
    if not np.all(weight <= float(jnp.finfo(dtype).max)):
        raise InputError(
            f"`{name}` is {sigma}; 1 / sigma^2 is beyond the numbers of {jnp.dtype(dtype)}: give a larger one, or hold "
            "what is exact (`fixed_intrinsics`)"
        )
    return weight
