"""Terminal output of a run: a progress bar, or log lines if the output is not a terminal; a report at the end."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from vggtgeo.datasets import Frame
from vggtgeo.evaluation.report import ABSURD_SCALE
from vggtgeo.io.errors import one_line
from vggtgeo.results.result import Result
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.state import Slam

MIN_PAUSE, MAX_PAUSE = 5.0, 60.0
"""Seconds between two log lines: few lines for short runs, a sign of life for long ones."""
PARTS = 10
"""Of a run: a log line for each, at least `MIN_PAUSE` apart."""


class ProgressBar(Callback):
    """Shows the number of frames, their rate, and the state's notes; a context manager, which removes the bar.

    A pipe or a file gets log lines instead of a bar.
    """

    def __init__(self, console: Console) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._lines = not console.is_terminal
        state = TextColumn("{task.fields[state]}")
        self._progress = Progress(*columns, state, console=console, disable=self._lines)
        self._notes = self._resumed = 0
        self._began = self._last_line = 0.0
        self._total: int | None = None
        self._part = 0
        self._stage: TaskID | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end_stage()
        self._progress.stop()

    def on_begin(self, name: str, total: int | None) -> None:
        self._task = self._progress.add_task(name, total=total, state="")
        self._began = self._last_line = time.perf_counter()
        self._total = total
        self._progress.start()

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        rate = (len(slam.frames) - self._resumed) / (time.perf_counter() - self._began)
        state = f"{rate:.1f} frames/s, {len(slam.keyframes)} keyframes, {_state(slam)}"
        self._progress.update(self._task, advance=1, state=state)
        if self._lines and self._is_due(len(slam.frames)):
            self._print(f"{len(slam.frames)}{f' of {self._total}' if self._total else ''} frames: {state}")
        for note in slam.notes[self._notes :]:
            self._print(f"warning: {note}")
        self._notes = len(slam.notes)

    def on_resume(self, so_far: None, slam: Slam) -> None:
        self._progress.update(self._task, completed=len(slam.frames))
        self._resumed, self._notes = len(slam.frames), len(slam.notes)
        self._print(f"resumed after frame {slam.frames[-1].frame}, with {len(slam.keyframes)} keyframes")

    def on_stage(self, name: str) -> None:
        """Show a stage in its own line, with a clock."""
        self._end_stage()
        self._stage = self._progress.add_task(name, total=None, state="")
        self._progress.start()
        if self._lines:
            self._print(name)

    def _is_due(self, done: int) -> bool:
        """Return whether it is time for a log line."""
        now, part = time.perf_counter(), PARTS * done // self._total if self._total else self._part
        pause = now - self._last_line
        due = pause >= MAX_PAUSE or (pause >= MIN_PAUSE and part > self._part)
        if due:
            self._last_line, self._part = now, part
        return due

    def _end_stage(self) -> None:
        if self._stage is not None:
            self._progress.update(self._stage, total=1, completed=1)
            self._stage = None

    def on_message(self, message: str) -> None:
        self._print(message)

    def _print(self, line: str) -> None:
        self._progress.console.print(one_line(line), markup=False, highlight=False)


def _state(slam: Slam) -> str:
    if slam.tracker.lost:
        return "lost"
    return "waiting for parallax" if slam.tracker.waiting else "tracking"


def errors_line(truth: Mapping[str, Any], free: bool) -> str:
    """Return the line with the errors against the ground truth. free: whether the estimate's scale is free."""
    se3, sim3 = (truth[name]["rmse"] for name in ("ate_se3_m", "ate_sim3_m"))
    if not truth["in_metres"]:
        return f"ATE {sim3:.4g} after Sim(3) alignment, in the ground truth's unit, which is not the metre"
    if free:
        return f"ATE {100 * sim3:.2f} cm after Sim(3) alignment (the scale is free)"
    line = f"ATE {100 * se3:.2f} cm after SE(3), {100 * sim3:.2f} cm after Sim(3) alignment"
    scale = truth["scale"]
    other = not 1 / ABSURD_SCALE <= scale <= ABSURD_SCALE
    return f"{line} with scale {scale:.3g}: are depth and ground truth in the same unit?" if other else line


def print_result(console: Console, result: Result, summary: Mapping[str, Any], folder: Path) -> None:
    """Print the report of a run; its last line is the verdict. summary: as written to `summary.json`."""
    verdict, (fx, fy, cx, cy) = result.verdict, result.intrinsics_as_read
    rate, whole = summary["frames_per_second"], summary["frames_per_second_whole_run"]
    lines = [
        f"{summary['frames']} frames ({summary['frames_tracked']} tracked), {summary['keyframes']} keyframes, "
        f"{rate:.1f} frames/s, {whole:.1f} including compilation and writing",
        f"intrinsics fx {fx:.1f} fy {fy:.1f} cx {cx:.1f} cy {cy:.1f}",
    ]
    if "images_reduced" in summary:
        sizes = summary["images_reduced"]
        lines[-1] += (
            f", of the original images; {sizes['from']} pixels were reduced to {sizes['to']} for everything else"
        )
    if summary["scale"].startswith("free"):
        lines.append(f"scale: {summary['scale']}")
    elif not verdict.metric:
        lines.append("scale: doubtful, lengths may not be metres")
    else:
        lines.append(f"scale: metric, by {summary['scale_basis']}")
    stated = summary.get("pose_sigma", {})
    if "translation_m" in stated:
        translation, rotation = stated["translation_m"], stated["rotation_deg"]
        lines.append(
            f"standard deviation of poses relative to the first: median {100 * translation['median']:.1f} cm and "
            f"{rotation['median']:.2f} deg, maximum {100 * translation['largest']:.1f} cm and "
            f"{rotation['largest']:.2f} deg (uncertainty.txt)"
        )
    if "truth" in summary:
        lines.append(errors_line(summary["truth"], free=summary["scale"].startswith("free")))
    points = f"({len(result.cloud)} points)"
    lines.append(f"outputs in {folder}: trajectory.txt keyframes.txt map.ply {points} report.html")
    lines += [f"- {reason}" for reason in verdict.reasons]
    lines.append(f"verdict: {verdict.level}")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
