"""The prior that marginalisation left, and which keyframes it speaks of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.bundle.marginalisation import reorder
from vggtgeo.bundle.terms.marginal import MarginalPrior


@dataclass(frozen=True, eq=False)
class WindowPrior:
    """A prior over poses, keyed by keyframe: a window that failed or was begun anew cannot take another's numbers.

    keyframes: number of each of the prior's places, those that have left included; a place beyond them is padding.
    """

    keyframes: tuple[int, ...]
    prior: MarginalPrior

    def aligned(self, numbers: Sequence[int], size: int) -> MarginalPrior:
        """The prior for a problem of `size` places whose first hold the keyframes `numbers`."""
        places = {number: row for row, number in enumerate(self.keyframes)}
        order = np.full(size, -1)
        order[: len(numbers)] = [places.get(number, -1) for number in numbers]
        return reorder(self.prior, order)
