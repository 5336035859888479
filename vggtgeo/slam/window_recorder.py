"""Records of the window adjustments, for the report of a run and for viewers."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residuals import residual_sizes
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm
from vggtgeo.datasets.frame import Frame
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.state import Slam


@dataclass(frozen=True)
class WindowRecord:
    """Record of one window adjustment: number and time of its newest keyframe's frame, residuals, iterations.

    rms, counts: RMS residual and number of observations of each term on landmarks and poses that has any, by its name;
    units: of the residuals (`px`, `sigma`). iterations: tried steps. energy: `1/2 sum rho` before and after.
    """

    frame: int
    timestamp: float
    rms: dict[str, float]
    counts: dict[str, int]
    units: dict[str, str]
    iterations: int
    energy: tuple[float, float]


class WindowRecorder(Callback):
    """Collect a `WindowRecord` of each adjustment."""

    def __init__(self) -> None:
        self.records: list[WindowRecord] = []
        self._last: object = None

    def so_far(self) -> tuple[WindowRecord, ...]:
        """Return the records."""
        return tuple(self.records)

    def on_resume(self, so_far: tuple[WindowRecord, ...], slam: Slam) -> None:
        """Continue with these records; the last window of `slam` is among them."""
        self.records = list(so_far)
        self._last = slam.window.solved

    @in_double_precision
    def on_warm_up(self, problem: Problem, state: State) -> None:
        jax.block_until_ready(residual_sizes(problem, state).rms)

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        self._note(slam)

    def on_adjust(self, slam: Slam) -> None:
        self._note(slam)

    @in_double_precision
    def _note(self, slam: Slam) -> None:
        if slam.window.solved is None or slam.window.solved is self._last:
            return
        self._last = slam.window.solved
        adjustment, state = slam.window.solved
        sizes = residual_sizes(adjustment.problem, state)
        shown = [term for term in adjustment.problem.terms if not isinstance(term, CameraTerm | DenseTerm)]
        counts = {term.name: count for term in shown if (count := int(sizes.count[term.name]))}
        newest = slam.keyframes[adjustment.keyframes[-1]]
        energies = slam.window.energies if slam.window.energies is not None else np.full(2, np.nan)
        self.records.append(
            WindowRecord(
                newest.frame,
                newest.timestamp,
                {name: float(sizes.rms[name]) for name in counts},
                counts,
                {term.name: term.unit for term in shown if term.name in counts},
                len(energies) - 1,
                (float(energies[0]), float(energies[-1])),
            )
        )
