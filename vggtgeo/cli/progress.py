"""Print the progress of a run, as a bar or, without a terminal, as log lines, and a report at the end."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column
from rich.text import Text

from vggtgeo.datasets import Frame
from vggtgeo.evaluation.report import ABSURD_SCALE
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import one_line
from vggtgeo.results.result import Result
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.findings import Verdict

LOG_INTERVAL = 20.0
"""Seconds between two log lines."""
NAME_WIDTH, BAR_WIDTH = 40, 16
"""Characters; a count of five digits and a clock next to them fit into 80 columns."""
MAX_SEGMENTS = 3
"""Maximum number of good segments in the line of the verdict."""


class _Count(ProgressColumn):
    """Column with the numbers of finished and of all frames; empty for a stage that does not count frames."""

    def render(self, task: Task) -> Text:
        if not task.fields["counts"]:
            return Text("")
        return Text(f"{int(task.completed)}/{'?' if task.total is None else int(task.total)}")


class _Bars(Progress):
    """Progress bars, and below them a line with the state of tracking, so that it does not displace bars and clocks.

    state: text of the line.
    """

    state = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        yield self.make_tasks_table(self.tasks)
        if self.state:
            yield Text(self.state, no_wrap=True, overflow="ellipsis")


class ProgressBar(Callback):
    """Shows the number of frames, their rate, and the notes of the run. A context manager, which removes the bar.

    If the output is not a terminal, it prints log lines instead of a bar.
    """

    def __init__(self, console: Console) -> None:
        name = Column(no_wrap=True, overflow="ellipsis", max_width=NAME_WIDTH)
        columns = (TextColumn("{task.description}", table_column=name, markup=False), BarColumn(bar_width=BAR_WIDTH))
        self._lines = not console.is_terminal
        self._progress = _Bars(*columns, _Count(), TimeElapsedColumn(), console=console, disable=self._lines)
        self._notes = self._resumed = 0
        self._began = self._last_line = 0.0
        self._total: int | None = None
        self._stage: TaskID | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end_stage()
        self._progress.stop()

    def on_begin(self, name: str, total: int | None) -> None:
        self._task = self._progress.add_task(name, total=total, counts=True)
        self._began = self._last_line = time.perf_counter()
        self._total = total
        self._progress.start()

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        rate = (len(slam.frames) - self._resumed) / (time.perf_counter() - self._began)
        tracking = "waiting for parallax" if slam.tracker.waiting else "tracking"
        status = "lost" if slam.tracker.lost else tracking
        state = f"{rate:.1f} frames/s, {len(slam.keyframes)} keyframes, {status}"
        self._progress.state = state
        self._progress.update(self._task, advance=1)
        if self._lines and time.perf_counter() >= self._last_line + LOG_INTERVAL:
            self._last_line = time.perf_counter()
            self._print(f"{len(slam.frames)}{f' of {self._total}' if self._total else ''} frames: {state}")
        self._print_new_notes(slam)

    def on_resume(self, so_far: None, slam: Slam) -> None:
        self._progress.update(self._task, completed=len(slam.frames))
        self._resumed, self._notes = len(slam.frames), len(slam.notes)
        self._print(f"resumed after frame {slam.frames[-1].frame}, with {len(slam.keyframes)} keyframes")

    def on_stage(self, name: str) -> None:
        """Show a stage in its own line, with a clock."""
        self._end_stage()
        self._progress.state = ""
        self._stage = self._progress.add_task(name, total=None, counts=False)
        self._progress.start()
        if self._lines:
            self._print(name)

    def on_stage_frame(self, done: int, total: int) -> None:
        if self._stage is not None:
            self._progress.update(self._stage, completed=done, total=total, counts=True)

    def on_finish(self, slam: Slam, cloud: PointCloud) -> None:
        self._print_new_notes(slam)

    def _end_stage(self) -> None:
        if self._stage is not None:
            total = next(task.total for task in self._progress.tasks if task.id == self._stage) or 1
            self._progress.update(self._stage, total=total, completed=total)
            self._stage = None

    def _print_new_notes(self, slam: Slam) -> None:
        for note in slam.notes[self._notes :]:
            self._print(f"note: {note}")
        self._notes = len(slam.notes)

    def on_message(self, message: str) -> None:
        self._print(message)

    def _print(self, line: str) -> None:
        self._progress.console.print(one_line(line), markup=False, highlight=False)


def duration(seconds: float) -> str:
    """Return a duration in words: "48 s", "6 min 18 s", "1 h 5 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes = whole // 60
    return f"{minutes} min {whole % 60} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def verdict_line(verdict: Verdict) -> str:
    """Return the level of the verdict; if it is not good, also the longest segments of good frames."""
    good = [part for part in verdict.segments if part.level == "good"]
    if verdict.level == "good" or not good:
        return f"verdict: {verdict.level}"
    longest = sorted(good, key=lambda part: part.start - part.end)[:MAX_SEGMENTS]
    frames = ", ".join(f"{part.start} to {part.end}" for part in sorted(longest, key=lambda part: part.start))
    return f"verdict: {verdict.level} (good: frames {frames}{' and others' * (len(good) > MAX_SEGMENTS)})"


def errors_line(truth: Mapping[str, Any], free: bool) -> str:
    """Return the line with the errors against the ground truth. free: whether the estimate's scale is unknown."""
    se3, sim3 = (truth[name]["rmse"] for name in ("ate_se3_m", "ate_sim3_m"))
    if not truth["in_metres"]:
        return f"ATE {sim3:.4g} after Sim(3) alignment, in the unit of the ground truth, which is not the metre"
    if free:
        return f"ATE {100 * sim3:.2f} cm after Sim(3) alignment (the scale is unknown)"
    line = f"ATE {100 * se3:.2f} cm after SE(3), {100 * sim3:.2f} cm after Sim(3) alignment"
    scale = truth["scale"]
    other = not 1 / ABSURD_SCALE <= scale <= ABSURD_SCALE
    return f"{line} with scale {scale:.3g}: are depth and ground truth in the same unit?" if other else line


def uncertainty_line(stated: Mapping[str, Any] | None, result: Result) -> str:
    """Return the line with the standard deviations of the poses; without a scale in per cent of the path's extent."""
    if stated is None:
        return "standard deviation of poses: unknown, the last adjustment was skipped or could not determine it"
    metric = "translation_m" in stated
    translation, rotation = stated["translation_m" if metric else "translation_unit"], stated["rotation_deg"]
    extent = float(np.linalg.norm(np.ptp(result.trajectory.positions, axis=0)))
    lengths = {name: 100 * value / (1.0 if metric else max(extent, 1e-12)) for name, value in translation.items()}
    unit = "cm" if metric else "% of the extent of the path"
    return (
        f"standard deviation of poses relative to the first: median {lengths['median']:.1f} {unit} and "
        f"{rotation['median']:.2f} deg, maximum {lengths['largest']:.1f} {unit} and {rotation['largest']:.2f} deg "
        "(uncertainty.txt)"
    )


def print_result(console: Console, result: Result, summary: Mapping[str, Any], folder: Path) -> None:
    """Print the report of a run; its last line is the verdict. summary: as written to `summary.json`."""
    verdict, (fx, fy, cx, cy) = result.verdict, result.intrinsics_as_read
    rate, whole = summary["frames_per_second"], duration(summary["seconds_by_stage"]["all"])
    lines = [
        f"{summary['frames']} frames in {whole} (tracking {rate:.1f} frames/s): {summary['frames_tracked']} tracked, "
        f"{summary['keyframes']} keyframes",
        f"intrinsics fx {fx:.1f} fy {fy:.1f} cx {cx:.1f} cy {cy:.1f}",
    ]
    if "images_reduced" in summary:
        sizes = summary["images_reduced"]
        lines[-1] += f" (of the original images; the run reduced {sizes['from']} pixels to {sizes['to']})"
    if summary["scale"].startswith("free"):
        lines.append(f"scale: {summary['scale']}")
    elif not verdict.metric:
        lines.append("scale: doubtful, lengths may not be metres")
    else:
        lines.append(f"scale: metric, by {summary['scale_basis']}")
    lines.append(uncertainty_line(summary.get("pose_sigma"), result))
    if "truth" in summary:
        lines.append(errors_line(summary["truth"], free=summary["scale"].startswith("free")))
    mesh = " mesh.ply" if (folder / "mesh.ply").is_file() else ""
    lines.append(
        f"outputs in {folder}: report.html trajectory.txt map.ply ({len(result.cloud)} points){mesh} summary.json"
    )
    lines += [f"- {reason}" for reason in verdict.reasons]
    lines.append(verdict_line(verdict))
    for line in lines:
        console.print(one_line(line), markup=False, highlight=False, soft_wrap=True)
