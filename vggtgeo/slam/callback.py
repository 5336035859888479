"""Callbacks of a run: the hooks of progress bars and viewers, and a recorder of window adjustments.

They do not change the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residual_values import residual_sizes
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm
from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.slam.state import Slam


class Callback:
    """Hooks of `vggtgeo.reconstruct`, in the order of their calls; each does nothing until a subclass overrides it.

    Example:
        >>> import vggtgeo as vg
        >>> class Progress(vg.Callback):
        ...     def on_frame(self, slam, frame):
        ...         print(f"frame {frame.index}: {slam}")

    """

    def on_warm_up(self, problem: Problem, state: State) -> None:
        """Called in another thread while the first frames are tracked, to compile for windows shaped as `problem`."""

    def on_begin(self, name: str, total: int | None) -> None:
        """Called before the first frame. total: number of frames, None if unknown."""

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Called with the state after `frame` (as read, before undistortion)."""

    def so_far(self) -> Any:
        """Return data for `on_resume` in a resumed run: numbers, texts, arrays, tuples of them; None: nothing.

        Called between two frames; the result must not be changed later.
        """
        return None

    def on_resume(self, so_far: Any, slam: Slam) -> None:
        """Called after `on_begin` of a resumed run, with the result of `so_far` after the last frame of `slam`."""

    def on_adjust(self, slam: Slam) -> None:
        """Called with the state after the last frame, before the global adjustment."""

    def on_stage(self, name: str) -> None:
        """Called when a stage before the first or after the last frame starts, which may take some seconds."""

    def on_stage_frame(self, done: int, total: int) -> None:
        """Called in a stage that counts frames (self-calibration), after each: `done` of `total`."""

    def on_message(self, message: str) -> None:
        """Called with an urgent message for the user."""

    def on_finish(self, slam: Slam, cloud: PointCloud) -> None:
        """Called with the state after the last adjustment, and the map."""


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
