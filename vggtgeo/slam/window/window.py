"""The sliding window: the newest keyframes, which are adjusted together, and the marginal prior from older ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.bundle.marginalisation import permute_prior
from vggtgeo.bundle.problem import State
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.slam.window.adjustment import Adjustment
from vggtgeo.solvers.levenberg_marquardt import IterationRecord


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


@dataclass(frozen=True, eq=False)
class Window:
    """The keyframes that are adjusted together.

    Fields:
        members: Their numbers, oldest first.
        prior: The prior from marginalised keyframes.
        held: Numbers of keyframes whose poses are fixed, besides roots of submaps.
        solved: The last problem of the window and its solution.
        energies: `1/2 sum rho` of that problem at the start and after each iteration.
        iterations: Record of the solver's iterations.

    """

    members: tuple[int, ...] = ()
    prior: WindowPrior | None = None
    held: tuple[int, ...] = ()
    solved: tuple[Adjustment, State] | None = None
    energies: np.ndarray | None = None
    iterations: IterationRecord | None = None
