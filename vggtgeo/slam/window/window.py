"""The sliding window: the newest keyframes, which are adjusted together during the run."""

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
        prior: The prior from marginalised keyframes.
        held: Numbers of keyframes whose poses are fixed, besides roots of submaps.
        solved: The last problem of the window and its solution.
        energies: `1/2 sum rho` of that problem at the start and after each iteration.
        iterations: Record of the solver's iterations, with the setting `window.record_iterations`.

    """

    members: tuple[int, ...] = ()
    prior: WindowPrior | None = None
    held: tuple[int, ...] = ()
    solved: tuple[Adjustment, State] | None = None
    energies: np.ndarray | None = None
    iterations: IterationRecord | None = None
