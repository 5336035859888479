"""`vggtgeo run`, `demo` and `warm-up`: estimate trajectory and map, try it in a synthetic office, compile in advance.

Heavy modules are imported inside functions, so that `vggtgeo run --help` is fast.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vggtgeo.cli.models import FLAGS
from vggtgeo.cli.options import (
    AssignmentsOption,
    InputOptions,
    JsonOption,
    OutputOption,
    PerceptionOptions,
    QuietOption,
    RerunOption,
    ResultOptions,
    ResumeOption,
    SequenceArgument,
    SwitchOptions,
    parse_size,
    with_option_groups,
)
from vggtgeo.cli.settings_file import SettingsOption, pipeline_settings
from vggtgeo.io.errors import GuessedCameraWarning, InputError, UnusableDepthWarning, collected_warnings, warn

if TYPE_CHECKING:
    from vggtgeo.datasets import Sequence
    from vggtgeo.slam.settings.presets import Perception
    from vggtgeo.slam.settings.slam_settings import Roles
    from vggtgeo.slam.settings.table import Tables


REFINE = {None: "auto", True: "always", False: "never"}
"""Setting for neither flag, `--refine-intrinsics`, and `--fix-intrinsics`."""
DEMO_SIZE = (480, 360)
"""Pixels: large enough for a dense map, small enough to render during the run."""


@with_option_groups
def run(
    path: SequenceArgument,
    output: OutputOption = Path("run"),
    settings: SettingsOption = None,
    *,
    given: InputOptions,
    switches: SwitchOptions,
    perception: PerceptionOptions,
    options: ResultOptions,
) -> None:
    """Estimate trajectory and map of the sequence at PATH."""
    if options.save_map is not None:
        check_map_file(options.save_map)
    with collected_warnings() as warned:
        sequence = open_input(path, given)
    from vggtgeo.cli.run_sequence import run_and_write
    from vggtgeo.results.reconstruction import RunOptions
    from vggtgeo.slam.run import default_roles

    slam_settings = pipeline_settings(settings, options.assignments or (), tables_of_switches(switches, options))
    perceived = make_perception(perception, default_roles(sequence.has_depth), switches)
    run_and_write(
        sequence,
        perceived,
        slam_settings,
        output,
        options,
        RunOptions(given.start, given.end, given.stride, options.seed, options.dense, warned=warned),
        flags=settings.values() if settings else {},
        source=Path(path),
    )


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")] = Path("runs/demo"),
    settings: SettingsOption = None,
    scene: Annotated[str, typer.Option(help="Scene: office, hall, corridor, staircase, building, room.")] = "office",
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of frames.")] = 45,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the scene and its noise.")] = 0,
    assignments: AssignmentsOption = None,
    rerun: RerunOption = None,
    resume: ResumeOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run in a synthetic office with exact ground truth, which is rendered first."""
    from vggtgeo.cli.run_sequence import run_and_write
    from vggtgeo.results.reconstruction import RunOptions
    from vggtgeo.simulation import simulate
    from vggtgeo.slam.settings.slam_settings import Roles
    from vggtgeo.slam.window.sliding_window import warm_up as compile_window

    slam_settings = pipeline_settings(settings, assignments or (), {})
    # Compile the adjustment of windows while the light of the scene is computed.
    with ThreadPoolExecutor(1, thread_name_prefix="compile") as pool:
        pool.submit(compile_window, slam_settings)
        sequence = simulate(scene, frames, seed, rate=10.0, size=DEMO_SIZE)
        if not (quiet or as_json):
            typer.echo(f"simulated scene `{scene}`: all results below are from a simulation")
        run_and_write(
            sequence,
            Roles(),
            slam_settings,
            output,
            ResultOptions(rerun=rerun, resume=resume, quiet=quiet, as_json=as_json),
            RunOptions(title=f"simulated {scene}", facts={"simulated": True}),
            flags=settings.values() if settings else {},
        )


def warm_up(
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the images with depth, pixels.")] = "640x480",
) -> None:
    """Fill the JIT cache for runs with default settings; takes some minutes once."""
    width, height = parse_size(size)

    from vggtgeo.slam.global_map.compile_ahead import compile_before_runs
    from vggtgeo.slam.settings.slam_settings import SlamSettings

    compile_before_runs(SlamSettings(), width, height)


def tables_of_switches(switches: SwitchOptions, options: ResultOptions) -> dict[str, Tables]:
    """Return the settings of each switch, by the name of its parameter."""
    from vggtgeo.slam.settings.groups import DepthSettings

    depth_weight = DepthSettings.depth_weight if switches.depth_prior else 0.0
    tables: dict[str, Tables] = {
        "no_lines": {"line": {"use_lines": not switches.no_lines}},
        "no_confidence": {"weights": {"confidence": "none" if switches.no_confidence else "measured"}},
        "depth_prior": {"depth_terms": {"depth_weight": depth_weight}},
        "global_adjustment": {"refinement": {"global_adjustment": switches.global_adjustment}},
        "refine_intrinsics": {"camera": {"refine_intrinsics": REFINE[switches.refine_intrinsics]}},
    }
    if options.localise_only:
        tables["localise_only"] = {"keyframes": {"localise_only": True}}
    return tables


def check_map_file(file: Path) -> None:
    """Raise InputError if the map's file is a folder, or is not writable."""
    from vggtgeo.results.output_checks import check_can_be_written

    if file.is_dir():
        raise InputError(f"`--save-map` must be a file, got the folder `{file}`")
    check_can_be_written(file.parent, "--save-map")


def chosen_roles(named: Mapping[str, str | None], no_lines: bool, no_confidence: bool) -> dict[str, str]:
    """Return the chosen implementation of each role; a disabled role is classical, so that it needs no network.

    Raises InputError if a disabled role was chosen.
    """
    disabled = {
        **({"lines": "--no-lines", "line_matches": "--no-lines"} if no_lines else {}),
        **({"confidence": "--no-confidence"} if no_confidence else {}),
    }
    for role, flag in disabled.items():
        if named[role] is not None:
            raise InputError(
                f"`{named[role]}` cannot be used with `{flag}`, which disables its role; give one of the two"
            )
    return {role: name for role, name in named.items() if name is not None} | dict.fromkeys(disabled, "classical")


def open_input(path: str | Path, given: InputOptions) -> Sequence:
    """Open the sequence at `path`, with the overrides of the flags."""
    from vggtgeo.datasets import open_sequence, parse_intrinsics, with_depth_scale, with_intrinsics, without_depth

    with warnings.catch_warnings():
        if given.intrinsics is not None:  # a guessed camera is replaced below
            warnings.simplefilter("ignore", GuessedCameraWarning)
        if given.depth_scale is not None:  # the unit of the depth is replaced below
            warnings.simplefilter("ignore", UnusableDepthWarning)
        sequence = open_sequence(path, given.kind, given.fps, depth=not given.rgb_only)
    if given.depth_scale is not None:
        sequence = with_depth_scale(sequence, given.depth_scale)
    if given.intrinsics is not None:
        sequence = with_intrinsics(sequence, parse_intrinsics(given.intrinsics))
    return without_depth(sequence) if given.rgb_only else sequence


def make_perception(chosen: PerceptionOptions, classical: Roles, switches: SwitchOptions) -> Perception:
    """Return the roles of a preset with the chosen replacements; warn of random weights and of an unused GPU."""
    from vggtgeo.slam.settings.presets import perception

    named = {role: getattr(chosen, flag.lstrip("-").replace("-", "_")) for role, flag in FLAGS.items()}
    mixed = chosen_roles(named, switches.no_lines, switches.no_confidence)
    perceived = perception(
        *(chosen.preset, classical, chosen.models, chosen.cache, chosen.provider, chosen.memory_limit_gb, mixed)
    )
    if chosen.provider == "cuda" and not perceived.networks:
        warn("`--provider cuda` has no effect: no role is a network")
    if perceived.random:
        warn(perceived.warning())
    return perceived
