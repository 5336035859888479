"""Summary statistics of errors."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of `count` non-negative errors, in their unit; NaN if there are none."""

    rmse: float
    mean: float
    median: float
    maximum: float
    count: int

    @classmethod
    def of(cls, errors: Float[np.ndarray, " n"]) -> Self:
        """Return the statistics of `errors` [n]."""
        if len(errors) == 0:
            return cls(np.nan, np.nan, np.nan, np.nan, 0)
        rmse = float(np.sqrt(np.mean(np.square(errors))))
        return cls(rmse, float(errors.mean()), float(np.median(errors)), float(errors.max()), len(errors))
