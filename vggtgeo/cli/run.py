"""`vggtgeo run`: a sequence in, a trajectory and a map out.

What is heavy is imported when a run begins, so that `vggtgeo run --help` answers at once.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vggtgeo.cli.options import AssignmentsOption, JsonOption, QuietOption, RerunOption
from vggtgeo.cli.settings_file import SettingsOption
from vggtgeo.io.errors import InputError, InputWarning

if TYPE_CHECKING:
    from vggtgeo.datasets import Sequence
    from vggtgeo.slam.presets import Perception
    from vggtgeo.slam.settings import Roles

Init = Literal["pnp", "constant-velocity"]
Features = Literal["sift", "orb"]
Preset = Literal["classical", "light", "paper"]
Provider = Literal["auto", "cuda", "cpu"]


def run(
    path: Annotated[Path, typer.Argument(help="Folder of a sequence, or a video file.", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")] = Path("run"),
    settings: SettingsOption = None,
    kind: Annotated[str | None, typer.Option(help="Reader: 7scenes, tum, images or video; found by looking.")] = None,
    start: Annotated[int, typer.Option(help="First frame.")] = 0,
    end: Annotated[int | None, typer.Option(help="Frame to stop before.")] = None,
    stride: Annotated[int, typer.Option(help="Take every n-th frame.")] = 1,
    intrinsics: Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels, in place of the folder's.")] = None,
    rgb_only: Annotated[
        bool, typer.Option("--rgb-only/--no-rgb-only", help="Ignore depth images: the scale stays free.")
    ] = False,
    lines: Annotated[
        bool, typer.Option("--lines/--no-lines", help="Residuals of lines; without them: an ablation.")
    ] = True,
    depth_prior: Annotated[
        bool,
        typer.Option(
            "--depth-prior/--no-depth-prior",
            help="Depth holds the estimate; without it, it starts it only: an ablation.",
        ),
    ] = True,
    confidence: Annotated[
        bool,
        typer.Option(
            "--confidence/--no-confidence", help="Weights by confidence; without it, all are one: an ablation."
        ),
    ] = True,
    global_adjustment: Annotated[
        bool,
        typer.Option(
            "--global/--no-global",
            help="One adjustment of the whole map at the end; without it, the sliding window alone: an ablation.",
        ),
    ] = True,
    init: Annotated[Init, typer.Option(help="How a new frame's pose starts.")] = "pnp",
    features: Annotated[Features, typer.Option(help="Key points.")] = "sift",
    preset: Annotated[
        Preset, typer.Option(help="Who perceives: classical code, or networks (see `vggtgeo models list`).")
    ] = "classical",
    models: Annotated[Path | None, typer.Option("--models", help="Folder of the networks' files.")] = None,
    cache: Annotated[Path | None, typer.Option("--cache", help="Folder to keep what the networks answer.")] = None,
    provider: Annotated[Provider, typer.Option(help="Where networks run.")] = "auto",
    memory_limit_gb: Annotated[
        float | None, typer.Option(help="Most GPU memory of each network, GB; has no effect on the CPU.")
    ] = None,
    save_depth: Annotated[
        bool, typer.Option("--save-depth/--no-save-depth", help="Write each keyframe's dense depth.")
    ] = False,
    assignments: AssignmentsOption = None,
    rerun: RerunOption = None,
    seed: Annotated[int, typer.Option(help="Seed of every random choice.")] = 0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate trajectory and map of the sequence at PATH."""
    from vggtgeo.cli.pipeline_settings import pipeline_settings
    from vggtgeo.cli.run_sequence import Output, run_and_write
    from vggtgeo.io.warned import collected_warnings
    from vggtgeo.slam.settings import DepthSettings
    from vggtgeo.viewing.target import check_target

    rerun = check_target(rerun) if rerun else None
    if preset == "paper" and features != "sift":
        raise InputError(f"`--features {features}` has no effect with `--preset paper`, whose points are MASt3R's")
    if memory_limit_gb is not None and not memory_limit_gb > 0:
        raise InputError(f"`--memory-limit-gb` is {memory_limit_gb:g}; it must be positive")
    with collected_warnings() as warned:
        sequence = open_input(path, kind, intrinsics, rgb_only)
    switches = {
        "lines": {"lines": {"use_lines": lines}},
        "confidence": {"confidence": {"use_confidence": confidence}},
        "depth_prior": {"depth": {"depth_weight": DepthSettings.depth_weight if depth_prior else 0.0}},
        "global_adjustment": {"refinement": {"global_adjustment": global_adjustment}},
    }
    slam_settings = pipeline_settings(settings, assignments or (), switches)
    perceived = make_perception(preset, make_roles(sequence, init, features), models, cache, provider, memory_limit_gb)
    flags = settings.values() if settings else {}
    run_and_write(
        sequence,
        perceived,
        slam_settings,
        Output(output, flags, rerun, save_depth, quiet, as_json),
        (start, end, stride),
        seed=seed,
        warned=warned,
    )


def open_input(path: Path, kind: str | None, intrinsics: str | None, rgb_only: bool) -> Sequence:
    """The sequence at `path`, with what the flags say otherwise."""
    from vggtgeo.datasets import open_sequence, parse_intrinsics, with_intrinsics, without_depth

    sequence = open_sequence(path, kind)
    if intrinsics is not None:
        sequence = with_intrinsics(sequence, parse_intrinsics(intrinsics))
    return without_depth(sequence) if rgb_only else sequence


def make_perception(
    preset: str,
    classical: Roles,
    models: Path | None,
    cache: Path | None,
    provider: Provider,
    memory_limit_gb: float | None,
) -> Perception:
    """The roles of a preset; warns of networks whose weights are random."""
    from vggtgeo.slam.presets import perception

    perceived = perception(preset, classical, models, cache, provider, memory_limit_gb)
    if perceived.random:
        warnings.warn(perceived.warning(), InputWarning, stacklevel=2)
    return perceived


def make_roles(sequence: Sequence, init: str, features: str) -> Roles:
    """The classical role objects for a sequence; the one place where names become objects."""
    from vggtgeo.models.classical import ConstantVelocity, NoDepth, OrbMatcher, SiftMatcher
    from vggtgeo.slam.settings import Roles

    roles = Roles(points={"sift": SiftMatcher, "orb": OrbMatcher}[features]())
    if init == "constant-velocity":
        # The ablation is a start by motion alone: nothing else may mend the pose before the window does.
        roles = replace(roles, geometry=ConstantVelocity(), alignment=None)
    if not sequence.has_depth:
        roles = replace(roles, depth=NoDepth())
    return roles
