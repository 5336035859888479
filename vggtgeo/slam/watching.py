"""Onlookers of a run: what draws or records while frames come in, and never changes the result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residuals import residual_sizes
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.slam.state import Slam

_SHOWN = ("points", "lines", "depth")
_sizes_jit = eqx.filter_jit(residual_sizes)


@runtime_checkable
class Watcher(Protocol):
    """Told of every frame once it is in the state, and of the end."""

    def see(self, slam: Slam, frame: Frame) -> None:
        """The state after `frame` (as it was read, before undistortion)."""
        ...

    def warm_up(self, problem: Problem, state: State) -> None:
        """Before the first frame: compile for windows of the shape of `problem`."""
        ...

    def finish(self, slam: Slam, cloud: PointCloud) -> None:
        """The state after the last adjustment, and the map."""
        ...


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


class WindowRecorder:
    """Collects a `WindowRecord` of each adjustment."""

    def __init__(self) -> None:
        self.records: list[WindowRecord] = []
        self._last: object = None

    def warm_up(self, problem: Problem, state: State) -> None:
        """Compile for windows of the shape of `problem`."""
        jax.block_until_ready(_sizes_jit(problem, state).rms)

    def see(self, slam: Slam, frame: Frame) -> None:
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

    def finish(self, slam: Slam, cloud: PointCloud) -> None:
        """Nothing: the last adjustment of the whole map is no window."""
