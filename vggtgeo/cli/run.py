"""`vggtgeo run`: a sequence in, a trajectory and a map out."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import cv2
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from vggtgeo.datasets import Sequence, open_sequence, parse_intrinsics, split, with_intrinsics, without_depth
from vggtgeo.errors import InputError, InputWarning
from vggtgeo.evaluation import TrajectoryReport
from vggtgeo.models.classical import ConstantVelocity, NoDepth, OrbMatcher, SiftMatcher
from vggtgeo.slam import outputs
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.run import finish
from vggtgeo.slam.run import run as run_slam
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window import warm_up
from vggtgeo.trajectory import Trajectory

if TYPE_CHECKING:
    from vggtgeo.cli.presets import Perception

Init = Literal["pnp", "constant-velocity"]
Features = Literal["sift", "orb"]
Preset = Literal["classical", "light", "paper"]


def run(
    path: Annotated[Path, typer.Argument(help="Folder of a sequence, or a video file.", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")] = Path("run"),
    kind: Annotated[str | None, typer.Option(help="Reader: 7scenes, tum, images or video; found by looking.")] = None,
    start: Annotated[int, typer.Option(help="First frame.")] = 0,
    end: Annotated[int | None, typer.Option(help="Frame to stop before.")] = None,
    stride: Annotated[int, typer.Option(help="Take every n-th frame.")] = 1,
    intrinsics: Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels, in place of the folder's.")] = None,
    rgb_only: Annotated[bool, typer.Option("--rgb-only", help="Ignore depth images: the scale stays free.")] = False,
    no_lines: Annotated[bool, typer.Option("--no-lines", help="Ablation: no line residuals.")] = False,
    no_depth_prior: Annotated[
        bool, typer.Option("--no-depth-prior", help="Ablation: depth starts the estimate but does not hold it.")
    ] = False,
    no_confidence: Annotated[bool, typer.Option("--no-confidence", help="Ablation: all weights are one.")] = False,
    no_global: Annotated[bool, typer.Option("--no-global", help="Ablation: the sliding window alone.")] = False,
    init: Annotated[Init, typer.Option(help="How a new frame's pose starts.")] = "pnp",
    features: Annotated[Features, typer.Option(help="Key points.")] = "sift",
    preset: Annotated[
        Preset, typer.Option(help="Who perceives: classical code, or networks (see `vggtgeo models list`).")
    ] = "classical",
    models: Annotated[Path | None, typer.Option("--models", help="Folder of the networks' files.")] = None,
    cache: Annotated[Path | None, typer.Option("--cache", help="Folder to keep what the networks answer.")] = None,
    save_depth: Annotated[bool, typer.Option("--save-depth", help="Write each keyframe's dense depth.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of every random choice.")] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no report.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Estimate trajectory and map of the sequence at PATH."""
    cv2.setRNGSeed(seed)
    sequence = open_sequence(path, kind)
    if intrinsics is not None:
        sequence = with_intrinsics(sequence, parse_intrinsics(intrinsics))
    if rgb_only:
        sequence = without_depth(sequence)
    settings = SlamSettings(
        use_lines=not no_lines,
        use_confidence=not no_confidence,
        depth_weight=0.0 if no_depth_prior else SlamSettings.depth_weight,
        global_adjustment=not no_global,
    )
    perceived = make_perception(preset, make_roles(sequence, init, features), models, cache)
    flags = {
        "path": str(path),
        **{"start": start, "end": end, "stride": stride, "intrinsics": intrinsics, "rgb_only": rgb_only},
        **{"no_lines": no_lines, "no_depth_prior": no_depth_prior, "no_confidence": no_confidence},
        **{"no_global": no_global, "init": init, "features": features, "seed": seed},
        **{"preset": preset, "models": models and str(models), "cache": cache and str(cache)},
    }
    run_and_write(
        sequence,
        perceived.roles,
        settings,
        output,
        flags,
        (start, end, stride),
        save_depth=save_depth,
        quiet=quiet or as_json,
        facts=perceived.facts(),
    )
    if as_json:
        typer.echo(json.dumps(json.loads((output / "summary.json").read_text())))


def make_perception(preset: str, classical: Roles, models: Path | None, cache: Path | None) -> Perception:
    """The roles of a preset; warns of networks whose weights are random."""
    from vggtgeo.cli.presets import perception

    perceived = perception(preset, classical, models, cache)
    if perceived.random:
        warnings.warn(perceived.warning(), InputWarning, stacklevel=2)
    return perceived


def make_roles(sequence: Sequence, init: str, features: str) -> Roles:
    """The classical role objects for a sequence; the one place where names become objects."""
    roles = Roles(points={"sift": SiftMatcher, "orb": OrbMatcher}[features]())
    if init == "constant-velocity":
        roles = replace(roles, geometry=ConstantVelocity())
    if not sequence.has_depth:
        roles = replace(roles, depth=NoDepth())
    return roles


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
) -> Slam:
    """Run a sequence with a progress bar, write every output into `folder`, and print the report."""
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
        flags,
        seconds,
        report,
        **facts,
        **{"map_points": points, "frames_per_second": round(frames_per_second, 2), "interrupted": interrupted},
    )
    _print_report(console, slam, report, folder, frames_per_second, points)
    return slam


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
