"""The window: the newest keyframes, which are adjusted together while the run goes on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.bundle.problem import State
from vggtgeo.slam.window.adjustment import Adjustment
from vggtgeo.slam.window.window_prior import WindowPrior
from vggtgeo.solvers.levenberg_marquardt import IterationRecord


@dataclass(frozen=True, eq=False)
class Window:
    """The keyframes that are adjusted together.

    Fields:
        members: Their numbers, oldest first.
        prior: The marginal prior that keyframes left when they were marginalised.
        held: Numbers of keyframes that the adjustment keeps where they are, besides roots of submaps.
        solved: The last problem of the window and its solution.
        energies: `1/2 sum rho` of that problem at the start and after each iteration.
        iterations: Record of the solver's iterations, where the settings ask for it.

    """

    members: tuple[int, ...] = ()
    prior: WindowPrior | None = None
    held: tuple[int, ...] = ()
    solved: tuple[Adjustment, State] | None = None
    energies: np.ndarray | None = None
    iterations: IterationRecord | None = None
