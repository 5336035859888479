"""The marginal prior of the window, keyed by keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.bundle.marginalisation import permute_prior
from vggtgeo.bundle.terms.marginal import MarginalPrior


@dataclass(frozen=True, eq=False)
class WindowPrior:
    """A prior over poses, keyed by keyframe, so that rows cannot be mixed up after a failed or new window.

    keyframes: keyframe number of each row of the prior, marginalised ones included; further rows are padding.
    """

    keyframes: tuple[int, ...]
    prior: MarginalPrior

    def aligned(self, numbers: Sequence[int], size: int) -> MarginalPrior:
        """Return the prior for a problem of `size` keyframes, the first of which are `numbers`."""
        places = {number: row for row, number in enumerate(self.keyframes)}
        order = np.full(size, -1)
        order[: len(numbers)] = [places.get(number, -1) for number in numbers]
        return permute_prior(self.prior, order)
