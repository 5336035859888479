"""The work of `vggtgeo run` and `vggtgeo demo`: the loop over frames with a progress bar, and every output."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from vggtgeo.cli.settings_file import write_settings
from vggtgeo.datasets import Sequence, split
from vggtgeo.errors import InputError, InputWarning
from vggtgeo.evaluation import TrajectoryReport
from vggtgeo.slam import outputs
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.run import finish
from vggtgeo.slam.run import run as run_slam
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window import warm_up
from vggtgeo.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Finished:
    """The last state of a run, and whether Ctrl-C ended it."""

    slam: Slam
    interrupted: bool


def run_and_write(
    sequence: Sequence,
    roles: Roles,
    settings: SlamSettings,
    folder: Path,
    flags: dict[str, Any],
    selection: tuple[int, int | None, int],
    *,
    save_depth: bool = False,
    quiet: bool = False,
    label: str = "",
    facts: Mapping[str, Any] = MappingProxyType({}),
) -> Finished:
    """Run a sequence with a progress bar, write every output into `folder`, and print the report.

    flags: the effective settings, by the names of the flags; `settings.toml` and `summary.json` hold them.
    facts: what else the summary shall say.
    """
    console = Console(stderr=False, quiet=quiet)
    clock, began = Clock(), time.perf_counter()
    with clock.measure("compile"):
        warm_up(settings)
    started = time.perf_counter()
    estimated, truth = _set_apart(sequence)
    folder.mkdir(parents=True, exist_ok=True)
    slam, interrupted = _fold(estimated, roles, settings, selection, clock, console)
    if slam is None or not slam.frames:
        raise InputError(f"`{sequence.name}` gave no frame that could be used; nothing was written")
    frames_per_second = len(slam.frames) / (time.perf_counter() - started)
    write_settings(folder / "settings.toml", flags)
    outputs.write_trajectories(folder, slam)
    if not interrupted:
        slam = finish(slam, roles, settings, clock)
        outputs.write_trajectories(folder, slam)
    with clock.measure("write"):
        points = outputs.write_map(folder, slam)
        outputs.write_plot(folder, slam, truth, label or sequence.name)
        if save_depth:
            outputs.write_depth(folder, slam)
    report = outputs.compare(slam, truth)
    seconds = {**clock.seconds, "all": time.perf_counter() - began}
    outputs.write_summary(
        folder,
        slam,
        {name.replace("-", "_"): value for name, value in flags.items()},
        seconds,
        report,
        **facts,
        **{"map_points": points, "frames_per_second": round(frames_per_second, 2), "interrupted": interrupted},
    )
    _print_report(console, slam, report, folder, frames_per_second, points)
    return Finished(slam, interrupted)


def _set_apart(sequence: Sequence) -> tuple[Sequence, Trajectory | None]:
    """The sequence without its truth, and the truth; a truth that cannot be read costs the comparison only."""
    try:
        return split(sequence)
    except InputError as error:
        warnings.warn(f"the truth cannot be used and is left out: {error}", InputWarning, stacklevel=2)
        return sequence, None


def _fold(
    sequence: Sequence,
    roles: Roles,
    settings: SlamSettings,
    selection: tuple[int, int | None, int],
    clock: Clock,
    console: Console,
) -> tuple[Slam | None, bool]:
    """The state after the last frame, and whether Ctrl-C ended the run."""
    start, end, stride = selection
    total = len(range(start, min(len(sequence), end if end is not None else len(sequence)), stride))
    slam: Slam | None = None
    said = 0
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.fields[state]}"), console=console) as progress:
        task = progress.add_task(sequence.name, total=total, state="")
        began = time.perf_counter()
        try:
            for slam in run_slam(sequence, roles, settings, start=start, end=end, stride=stride, clock=clock):
                rate = len(slam.frames) / (time.perf_counter() - began)
                state = f"{rate:.1f} frames/s, {len(slam.keyframes)} keyframes, {_state(slam)}"
                progress.update(task, advance=1, state=state)
                for note in slam.notes[said:]:
                    progress.console.print(f"warning: {note}", markup=False, highlight=False)
                said = len(slam.notes)
        except KeyboardInterrupt:
            console.print("interrupted: writing what there is")
            return slam, True
    return slam, False


def _state(slam: Slam) -> str:
    if slam.lost:
        return "lost"
    return "waiting for parallax" if slam.waiting else "tracking"


def _print_report(
    console: Console, slam: Slam, report: TrajectoryReport | None, folder: Path, rate: float, points: int
) -> None:
    fx, fy, cx, cy = slam.intrinsics
    tracked = sum(record.tracked for record in slam.frames)
    lines = [
        f"{len(slam.frames)} frames ({tracked} tracked), {len(slam.keyframes)} keyframes, {rate:.1f} frames/s",
        f"intrinsics fx {fx:.1f} fy {fy:.1f} cx {cx:.1f} cy {cy:.1f}",
    ]
    if not slam.metric:
        lines.append("scale: free, there is no metric depth; lengths have no unit")
    if report is not None:
        se3, sim3 = report.se3.statistics.rmse, report.sim3.statistics.rmse
        lines.append(f"ATE {100 * se3:.2f} cm after SE(3), {100 * sim3:.2f} cm after Sim(3) alignment")
    lines.append(f"outputs in {folder}: trajectory.txt keyframes.txt map.ply ({points} points) trajectory.png")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
