"""What each adjustment of the window left, for the page of a run and for viewers."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residuals import residual_sizes
from vggtgeo.datasets.frame import Frame
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.state import Slam

_SHOWN = ("points", "lines", "depth")
_sizes_jit = eqx.filter_jit(residual_sizes)


@dataclass(frozen=True)
class WindowRecord:
    """What one adjustment of the window left: number and time of the frame, residuals, effort.

    points, lines: RMS residual, pixels; depth: in standard deviations; NaN where the window has none. counts: of the
    three kinds. iterations: tried steps. energy: `1/2 sum rho` before and after.
    """

    frame: int
    timestamp: float
    points: float
    lines: float
    depth: float
    counts: tuple[int, ...]
    iterations: int
    energy: tuple[float, float]


class WindowRecorder(Callback):
    """Collects a `WindowRecord` of each adjustment."""

    def __init__(self) -> None:
        self.records: list[WindowRecord] = []
        self._last: object = None

    def on_warm_up(self, problem: Problem, state: State) -> None:
        jax.block_until_ready(_sizes_jit(problem, state).rms)

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        if slam.solved is None or slam.solved is self._last:
            return
        self._last = slam.solved
        adjustment, state = slam.solved
        sizes = _sizes_jit(adjustment.problem, state)
        points, lines, depth = (float(sizes.rms.get(name, np.nan)) for name in _SHOWN)
        energies = slam.energies if slam.energies is not None else np.full(2, np.nan)
        self.records.append(
            WindowRecord(
                frame.index,
                frame.timestamp,
                points,
                lines,
                depth,
                tuple(int(sizes.count.get(name, 0)) for name in _SHOWN),
                len(energies) - 1,
                (float(energies[0]), float(energies[-1])),
            )
        )
