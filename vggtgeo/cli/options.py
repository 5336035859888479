"""Define the options that several commands share, and the groups of options of `vggtgeo run`.

Every switch has an opposite, so that the command line can override a settings file.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from vggtgeo.io.errors import InputError
from vggtgeo.results.output_checks import CHECKPOINT_SECONDS

EXIT_INTERNAL = 1
EXIT_INPUT = 2
EXIT_FAILED = 3
"""The run ended with the verdict "failed"; its outputs are written."""
EXIT_INTERRUPTED = 130
"""After Ctrl-C."""
QuietOption = Annotated[bool, typer.Option("--quiet/--no-quiet", help="Print neither a progress bar nor a report.")]
JsonOption = Annotated[bool, typer.Option("--json/--no-json", help="Print only one JSON object.")]


def _moved_with_output(context: Any, parameter: Any, target: str | None) -> str | None:
    """Return `target`; if the settings file has it in the output folder, and a flag changes that folder, change both.

    Otherwise a repeated run into a new folder would overwrite the recording of the old run.
    """
    source = context.get_parameter_source(parameter.name)
    old, new = (context.default_map or {}).get("output"), context.params.get("output")
    if target is None or source is None or source.name != "DEFAULT_MAP" or old is None or new is None:
        return target
    try:
        return str(Path(new) / Path(target).relative_to(old))
    except ValueError:  # `spawn`, `serve`, or a file elsewhere
        return target


AssignmentsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="GROUP.FIELD=VALUE",
        help="A setting of the pipeline, such as keyframes.min_inliers=20; may be given several times.",
    ),
]
RerunOption = Annotated[
    str | None,
    typer.Option(
        "--rerun",
        metavar="TARGET",
        callback=_moved_with_output,
        help="Log to Rerun: spawn, serve, or a file ending with .rrd.",
    ),
]
Provider = Literal["auto", "cuda", "cpu"]
SequenceArgument = Annotated[
    str, typer.Argument(help="Folder of a sequence, video file, ROS bag, webcam:0, or rtsp://...", show_default=False)
]
OutputOption = Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")]
ResumeOption = Annotated[
    bool | None,
    typer.Option(
        "--resume/--no-resume",
        help="Continue a killed run in this folder, or start again; without either, a killed run is an error.",
        show_default=False,
    ),
]


@dataclass(frozen=True)
class InputOptions:
    """Which frames are read, and how."""

    kind: Annotated[
        str | None,
        typer.Option(
            help="Reader: images, rgbd, tum, video, bag, camera, ... (`vggtgeo data list`); by default detected."
        ),
    ] = None
    start: Annotated[int, typer.Option(min=0, help="First frame.")] = 0
    end: Annotated[int | None, typer.Option(min=1, help="Frame to stop before.")] = None
    stride: Annotated[int, typer.Option(min=1, help="Take every n-th frame.")] = 1
    fps: Annotated[
        float | None, typer.Option(help="Frames per second of a video or a folder of images, instead of the file's.")
    ] = None
    intrinsics: Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels, instead of the folder's.")] = None
    rgb_only: Annotated[bool, typer.Option(help="Ignore depth images: the scale is unknown.")] = False
    depth_scale: Annotated[
        float | None,
        typer.Option(help="Units per metre of depth files, instead of their layout's: 1000 is millimetres."),
    ] = None


@dataclass(frozen=True)
class SwitchOptions:
    """Switches of the pipeline: ablations, and the last adjustment."""

    no_lines: Annotated[
        bool, typer.Option("--no-lines/--use-lines", help="Use no residuals of lines: an ablation.")
    ] = False
    depth_prior: Annotated[
        bool, typer.Option(help="Use depth as a prior; without it only as a start: an ablation.")
    ] = True
    no_confidence: Annotated[
        bool, typer.Option("--no-confidence/--use-confidence", help="Give all matches the same weight: an ablation.")
    ] = False
    global_adjustment: Annotated[
        bool,
        typer.Option(
            "--global/--no-global",
            help="Adjust the whole map at the end; without it only the sliding window: an ablation.",
        ),
    ] = True
    refine_intrinsics: Annotated[
        bool | None,
        typer.Option(
            "--refine-intrinsics/--fix-intrinsics",
            help="Whether the last adjustment may change known intrinsics; by default if the images require it.",
            show_default=False,
        ),
    ] = None


@dataclass(frozen=True)
class PerceptionOptions:
    """Implementations of the perception roles, by the names of `vggtgeo.slam.settings.presets.CHOICES`."""

    preset: Annotated[
        Literal["classical", "light", "paper"],
        typer.Option(
            help="Implementation of the perception roles: classical code, or networks (see `vggtgeo models list`)."
        ),
    ] = "classical"
    models: Annotated[Path | None, typer.Option(help="Folder of the networks' files.")] = None
    cache: Annotated[Path | None, typer.Option(help="Folder for cached outputs of the networks.")] = None
    provider: Annotated[Provider, typer.Option(help="Device that networks run on.")] = "auto"
    memory_limit_gb: Annotated[
        float | None, typer.Option(help="Maximum GPU memory of each network, GB; no effect on the CPU.")
    ] = None
    points: Annotated[
        Literal["classical", "orb", "mast3r", "alike", "alike-tiny", "xfeat"] | None,
        typer.Option(help="Point matcher, instead of the preset's; classical is SIFT."),
    ] = None
    lines: Annotated[
        Literal["classical", "letr", "mlsd"] | None,
        typer.Option(help="Line detector, instead of the preset's; classical is LSD."),
    ] = None
    line_matcher: Annotated[
        Literal["classical", "dinov3", "dinov3-small"] | None,
        typer.Option(help="Line matcher, instead of the preset's; classical is bands of gradients."),
    ] = None
    confidence: Annotated[
        Literal["classical", "dinov3", "dinov3-small"] | None,
        typer.Option(help="Confidence of matches, instead of the preset's; classical is the structure tensor."),
    ] = None
    init: Annotated[
        Literal["classical", "constant-velocity", "vggt"] | None,
        typer.Option(
            help="Initial pose of a frame, instead of the preset's; classical is PnP and two views; "
            "constant-velocity: an ablation."
        ),
    ] = None
    depth: Annotated[
        Literal["classical", "moge2", "moge2-small"] | None,
        typer.Option(help="Metric depth, instead of the preset's; classical is the sensor's."),
    ] = None


@dataclass(frozen=True)
class ResultOptions:
    """Results of the run, maps to read and write, and its report."""

    dense: Annotated[
        Literal["auto", "mvs", "sensor", "network", "none"],
        typer.Option(
            help="Depth of the dense map: mvs (from the images, also where measured depth has holes), sensor, network, "
            "none (points only), or auto (sensor or network, else mvs)."
        ),
    ] = "auto"
    save_depth: Annotated[bool, typer.Option(help="Write the dense depth of each keyframe.")] = False
    save_every_depth: Annotated[
        bool,
        typer.Option(
            help="Write depth and image of every frame; depth that no sensor measured comes from near keyframes."
        ),
    ] = False
    assignments: AssignmentsOption = None
    rerun: RerunOption = None
    map_file: Annotated[
        Path | None,
        typer.Option("--map", help="Map of an earlier run (`--save-map`) to localise in and extend."),
    ] = None
    localise_only: Annotated[bool, typer.Option(help="Localise in the map of `--map` without extending it.")] = False
    save_map: Annotated[Path | None, typer.Option(help="File for the map, which another run can extend.")] = None
    pose_prior: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|recorded",
            help="Poses to use as a motion prior: those of the recording (then it has no ground truth), or of a file.",
        ),
    ] = None
    resume: ResumeOption = None
    checkpoint_every: Annotated[
        float,
        typer.Option(help="Seconds between checkpoints for `--resume`; 0: after every frame."),
    ] = CHECKPOINT_SECONDS
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="Seed of the random samples of robust estimators.")
    ] = 0
    quiet: QuietOption = False
    as_json: JsonOption = False


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each parameter of `command` whose type is a dataclass by options, one for each field.

    The options have the order of the parameters and fields, and the defaults of the fields.
    """
    hints = typing.get_type_hints(command, include_extras=True)
    groups = {name: kind for name, kind in hints.items() if isinstance(kind, type) and dataclasses.is_dataclass(kind)}
    options: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        source = groups.get(name)
        types = hints if source is None else typing.get_type_hints(source, include_extras=True)
        own = [parameter] if source is None else inspect.signature(source).parameters.values()
        options += [one.replace(annotation=types[one.name]) for one in own]

    @functools.wraps(command)
    def with_groups(**values: Any) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{entry.name: values.pop(entry.name) for entry in dataclasses.fields(kind)})
        command(**values)

    with_groups.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    with_groups.__annotations__ = {option.name: option.annotation for option in options}
    return with_groups


def parse_size(text: str) -> tuple[int, int]:
    """Parse a text like 640x480 as (width, height); raise InputError for anything else."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise InputError(f"`--size` must be two integers, as in 640x480, got {text!r}") from None
    if min(width, height) < 16 or max(width, height) > 8192:
        raise InputError(f"`--size` must have sides of 16 to 8192 pixels, got {text!r}")
    return width, height
