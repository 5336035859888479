"""The work of `vggtgeo run` and `vggtgeo demo`: the loop over frames with a progress bar, and every output."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from vggtgeo.cli.settings_file import write_settings
from vggtgeo.datasets import Frame, Sequence, split
from vggtgeo.evaluation import TrajectoryReport
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.report import write_page
from vggtgeo.slam import outputs
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.keyframe_depth import fused_depths
from vggtgeo.slam.run import finish, run_frames
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.evidence import EvidenceRecorder
from vggtgeo.slam.trust.finding import Verdict
from vggtgeo.slam.trust.input import check_input
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.watching import Watcher, WindowRecorder
from vggtgeo.slam.window import warm_up


@dataclass(frozen=True, eq=False)
class Finished:
    """The last state of a run, how far it can be trusted, whether Ctrl-C ended it, and the address of a served view."""

    slam: Slam
    verdict: Verdict
    interrupted: bool
    url: str | None = None


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
    facts: Callable[[], Mapping[str, Any]] = dict,
    rerun: str | None = None,
    warned: Iterable[Warning | str] = (),
) -> Finished:
    """Run a sequence with a progress bar, write every output into `folder`, and print the report.

    flags: the effective settings, by the names of the flags; `settings.toml` and `summary.json` hold them.
    facts: what else the summary shall say, asked for at the end. rerun: where to log the run, see
    `vggtgeo/viewing/target.py`. warned: what was said of the input when it was opened.
    """
    console = Console(stderr=False, quiet=quiet)
    watchers: tuple[Watcher, ...] = ()
    url = None
    if rerun is not None:
        watcher, url = _rerun_watcher(rerun, label or sequence.name, folder)
        watchers, settings = (watcher,), replace(settings, record_iterations=True)
    clock, began = Clock(), time.perf_counter()
    recorder, witness = WindowRecorder(), EvidenceRecorder(sequence.camera)
    with clock.measure("compile"):
        compiled = warm_up(settings, roles.metric)
        for watcher in (recorder, *watchers):
            watcher.warm_up(*compiled)
    with collected_warnings() as said:
        estimated, truth = _set_apart(sequence)
        folder.mkdir(parents=True, exist_ok=True)
        fold = _fold(estimated, roles, settings, selection, clock, console, (recorder, witness, *watchers))
    slam = fold.slam
    write_settings(folder / "settings.toml", flags)
    outputs.write_trajectories(folder, slam)
    interrupted = fold.interrupted
    if not interrupted:
        try:
            slam = finish(slam, roles, settings, clock)
        except KeyboardInterrupt:
            console.print("interrupted: writing what there is, without the last adjustment")
            interrupted = True
        outputs.write_trajectories(folder, slam)
    with clock.measure("write"):
        depths = fused_depths(slam.keyframes, slam.intrinsics)
        cloud = outputs.write_map(folder, slam, depths)
        outputs.write_plot(folder, slam, truth, label or sequence.name)
        if save_depth:
            outputs.write_depth(folder, slam, depths)
    with clock.measure("record and draw"):
        for watcher in watchers:
            watcher.finish(slam, cloud)
    with clock.measure("verdict"):
        warned = [*warned, *said]
        verdict = judge(slam, witness.frames, check_input(warned, len(slam.frames)))
    report = outputs.compare(slam, truth)
    told = facts()
    summary = outputs.write_summary(
        folder,
        slam,
        {name.replace("-", "_"): value for name, value in flags.items()},
        {**clock.seconds, "all": time.perf_counter() - began},
        report,
        verdict,
        **told,
        map_points=len(cloud),
        frames_per_second=round(fold.frames_per_second, 2),
        interrupted=interrupted,
    )
    write_page(
        folder / "report.html",
        slam,
        title=label or sequence.name,
        truth=truth,
        cloud=cloud,
        records=recorder.records,
        summary={**summary, "settings": flags},
        verdict=verdict,
        warnings=[*([told["meaningless"]] if "meaningless" in told else []), *map(str, warned)],
    )
    _print_report(console, slam, report, folder, fold.frames_per_second, len(cloud), verdict)
    return Finished(slam, verdict, interrupted, url)


def _rerun_watcher(target: str, name: str, folder: Path) -> tuple[Watcher, str | None]:
    """The watcher, and where a served run is to be seen."""
    from vggtgeo.viewing.target import STAND_IN, open_target  # rerun is imported only when it is asked for
    from vggtgeo.viewing.watcher import RerunWatcher

    opened = open_target(target, name, folder / STAND_IN)
    if opened.url is not None:
        typer.echo(f"follow the run in a browser: {opened.url}", err=True)
    return RerunWatcher(opened.stream), opened.url


def _set_apart(sequence: Sequence) -> tuple[Sequence, Trajectory | None]:
    """The sequence without its truth, and the truth; a truth that cannot be read costs the comparison only."""
    try:
        return split(sequence)
    except InputError as error:
        warnings.warn(f"the truth cannot be used and is left out: {error}", InputWarning, stacklevel=2)
        return sequence, None


@dataclass(frozen=True, eq=False)
class _Fold:
    slam: Slam
    interrupted: bool
    frames_per_second: float


def _fold(
    sequence: Sequence,
    roles: Roles,
    settings: SlamSettings,
    selection: tuple[int, int | None, int],
    clock: Clock,
    console: Console,
    watchers: Iterable[Watcher],
) -> _Fold:
    """The loop over frames; Ctrl-C ends it early, an input error of the sequence ends it without a result."""
    start, end, stride = selection
    total = len(range(start, min(len(sequence), end if end is not None else len(sequence)), stride))
    slam: Slam | None = None
    interrupted = False
    given: dict[int, Frame] = {}
    frames = _remembered(sequence.frames(start, end, stride), given)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.fields[state]}"), console=console) as progress:
        task = progress.add_task(sequence.name, total=total, state="")
        began = time.perf_counter()
        try:
            for slam in run_frames(frames, sequence.camera, roles, settings, clock):
                _show(progress, task, slam, time.perf_counter() - began)
                frame = given.pop(slam.frames[-1].frame)
                for watcher in watchers:
                    with clock.measure("record and draw"):
                        watcher.see(slam, frame)
        except KeyboardInterrupt:
            interrupted = True
    if slam is None or not slam.frames:
        if interrupted:
            raise KeyboardInterrupt
        raise InputError(f"`{sequence.name}` gave no frame that could be used; nothing was written")
    if interrupted:
        console.print("interrupted: writing what there is")
    return _Fold(slam, interrupted, len(slam.frames) / (time.perf_counter() - began))


def _remembered(frames: Iterable[Frame], given: dict[int, Frame]) -> Iterator[Frame]:
    """The same frames, each kept in `given` by its index until somebody takes it."""
    for frame in frames:
        given[frame.index] = frame
        yield frame


def _show(progress: Progress, task: TaskID, slam: Slam, seconds: float) -> None:
    state = f"{len(slam.frames) / seconds:.1f} frames/s, {len(slam.keyframes)} keyframes, {_state(slam)}"
    progress.update(task, advance=1, state=state)
    said = progress.tasks[0].fields.get("said", 0)
    for note in slam.notes[said:]:
        progress.console.print(f"warning: {note}", markup=False, highlight=False)
    progress.update(task, said=len(slam.notes))


@contextmanager
def collected_warnings() -> Iterator[list[Warning | str]]:
    """The warnings about the input, in order, gathered while they are shown as before."""
    said: list[Warning | str] = []
    show_as_before = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, InputWarning):
            said.append(message)
        show_as_before(message, category, *rest, **more)

    warnings.showwarning = show
    try:
        yield said
    finally:
        warnings.showwarning = show_as_before


def _state(slam: Slam) -> str:
    if slam.lost:
        return "lost"
    return "waiting for parallax" if slam.waiting else "tracking"


def _print_report(
    console: Console,
    slam: Slam,
    report: TrajectoryReport | None,
    folder: Path,
    rate: float,
    points: int,
    verdict: Verdict,
) -> None:
    fx, fy, cx, cy = slam.intrinsics
    tracked = sum(record.tracked for record in slam.frames)
    lines = [
        f"{len(slam.frames)} frames ({tracked} tracked), {len(slam.keyframes)} keyframes, {rate:.1f} frames/s",
        f"intrinsics fx {fx:.1f} fy {fy:.1f} cx {cx:.1f} cy {cy:.1f}",
    ]
    if not slam.metric:
        lines.append("scale: free, there is no metric depth; lengths have no unit")
    elif not verdict.metric:
        lines.append("scale: doubtful, lengths may be no metres")
    else:
        lines.append(f"scale: metric, by {outputs.SCALE_BASIS}")
    if report is not None:
        se3, sim3 = report.se3.statistics.rmse, report.sim3.statistics.rmse
        lines.append(f"ATE {100 * se3:.2f} cm after SE(3), {100 * sim3:.2f} cm after Sim(3) alignment")
    lines.append(f"outputs in {folder}: trajectory.txt keyframes.txt map.ply ({points} points) report.html")
    lines += [f"- {reason}" for reason in verdict.reasons]
    lines.append(f"verdict: {verdict.level}")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
