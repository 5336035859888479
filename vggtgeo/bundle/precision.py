"""Range of the precision of a problem: finite numbers must not overflow, and positive numbers must not underflow."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax.typing import DTypeLike


def weight_of(name: str, sigma: Any, dtype: DTypeLike) -> Any:
    """Return `1 / sigma^2` of the argument `name`; 0 if `sigma^2` overflows.

    Raises:
        InputError: `sigma` is so small that the weight is infinite.

    """
    with np.errstate(over="ignore", divide="ignore"):
        weight = 1 / np.square(np.asarray(sigma, np.float64))
    return weight
