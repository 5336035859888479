"""`vggtgeo run`: a sequence in, a trajectory and a map out.

What is heavy is imported when a run begins, so that `vggtgeo run --help` answers at once.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vggtgeo.cli.options import EXIT_FAILED, EXIT_INTERRUPTED, JsonOption, QuietOption, RerunOption
from vggtgeo.cli.settings_file import SettingsOption
from vggtgeo.cli.view import serve_until_interrupted
from vggtgeo.io.errors import InputError, InputWarning

if TYPE_CHECKING:
    from vggtgeo.cli.presets import Perception
    from vggtgeo.datasets import Sequence
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
    refine_intrinsics: Annotated[
        bool | None,
        typer.Option(
            "--refine-intrinsics/--fix-intrinsics",
            help="Whether the last adjustment may move known intrinsics; by default where it pays.",
            show_default=False,
        ),
    ] = None,
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
    rerun: RerunOption = None,
    seed: Annotated[int, typer.Option(help="Seed of every random choice.")] = 0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate trajectory and map of the sequence at PATH."""
    import cv2

    from vggtgeo.cli.network_errors import as_input_errors
    from vggtgeo.cli.run_sequence import collected_warnings, run_and_write
    from vggtgeo.datasets import open_sequence, parse_intrinsics, with_intrinsics, without_depth
    from vggtgeo.slam.settings import SlamSettings
    from vggtgeo.viewing.target import check_target

    rerun = check_target(rerun) if rerun else None
    cv2.setRNGSeed(seed)
    with collected_warnings() as warned:
        sequence = open_sequence(path, kind)
    if intrinsics is not None:
        sequence = with_intrinsics(sequence, parse_intrinsics(intrinsics))
    if rgb_only:
        sequence = without_depth(sequence)
    slam_settings = SlamSettings(
        use_lines=lines,
        use_confidence=confidence,
        depth_weight=SlamSettings.depth_weight if depth_prior else 0.0,
        global_adjustment=global_adjustment,
        refine_intrinsics="auto" if refine_intrinsics is None else "always" if refine_intrinsics else "never",
    )
    if preset == "paper" and features != "sift":
        raise InputError(f"`--features {features}` has no effect with `--preset paper`, whose points are MASt3R's")
    if memory_limit_gb is not None and not memory_limit_gb > 0:
        raise InputError(f"`--memory-limit-gb` is {memory_limit_gb:g}; it must be positive")
    perceived = make_perception(preset, make_roles(sequence, init, features), models, cache, provider, memory_limit_gb)
    with as_input_errors():
        finished = run_and_write(
            sequence,
            perceived.roles,
            slam_settings,
            output,
            settings.values() if settings else {},
            (start, end, stride),
            save_depth=save_depth,
            rerun=rerun,
            quiet=quiet or as_json,
            facts=perceived.facts,
            warned=warned,
        )
    if as_json:
        typer.echo(json.dumps(json.loads((output / "summary.json").read_text())))
    if rerun == "serve":
        serve_until_interrupted(finished.url, quiet or as_json)
    if finished.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)
    if finished.verdict.level == "failed":
        raise typer.Exit(EXIT_FAILED)


def make_perception(
    preset: str,
    classical: Roles,
    models: Path | None,
    cache: Path | None,
    provider: Provider,
    memory_limit_gb: float | None,
) -> Perception:
    """The roles of a preset; warns of networks whose weights are random."""
    from vggtgeo.cli.presets import perception

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
