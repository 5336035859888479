"""Options that several commands share, and those of `vggtgeo run` in groups, each with its help.

Every switch has its opposite, so that a flag can override a settings file.
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
from vggtgeo.results.output_checks import EVERY

EXIT_INTERNAL = 1
EXIT_INPUT = 2
EXIT_FAILED = 3
"""The run ended with the verdict "failed"; its outputs are written."""
EXIT_INTERRUPTED = 130
"""After Ctrl-C."""
QuietOption = Annotated[bool, typer.Option("--quiet/--no-quiet", help="Say nothing: no progress bar, no report.")]
JsonOption = Annotated[bool, typer.Option("--json/--no-json", help="Print one JSON object and nothing else.")]


def _beside_output(context: Any, parameter: Any, target: str | None) -> str | None:
    """Return `target`; if a settings file puts it into its output folder, and a flag changes that folder, move it too.

    Else a repeated run into a new folder would overwrite the recording of the old one.
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
        callback=_beside_output,
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
        help="Go on with a run into this folder that was killed, or begin anew; without either, such a folder is "
        "refused.",
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
    rgb_only: Annotated[bool, typer.Option(help="Ignore depth images: the scale stays free.")] = False
    depth_scale: Annotated[
        float | None,
        typer.Option(help="Units per metre of depth files, instead of their layout's: 1000 is millimetres."),
    ] = None


@dataclass(frozen=True)
class SwitchOptions:
    """Switches of the pipeline's settings: ablations, and the last adjustment."""

    no_lines: Annotated[
        bool, typer.Option("--no-lines/--use-lines", help="Leave out residuals of lines: an ablation.")
    ] = False
    depth_prior: Annotated[
        bool, typer.Option(help="Depth holds the estimate; without it, it starts it only: an ablation.")
    ] = True
    no_confidence: Annotated[
        bool, typer.Option("--no-confidence/--use-confidence", help="All matches weigh the same: an ablation.")
    ] = False
    global_adjustment: Annotated[
        bool,
        typer.Option(
            "--global/--no-global",
            help="One adjustment of the whole map at the end; without it, the sliding window alone: an ablation.",
        ),
    ] = True
    refine_intrinsics: Annotated[
        bool | None,
        typer.Option(
            "--refine-intrinsics/--fix-intrinsics",
            help="Whether the last adjustment may change known intrinsics; by default where the images require it.",
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
    provider: Annotated[Provider, typer.Option(help="Where networks run.")] = "auto"
    memory_limit_gb: Annotated[
        float | None, typer.Option(help="Most GPU memory of each network, GB; has no effect on the CPU.")
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
    """Results of the run, maps that it reads and writes, and its report."""

    dense: Annotated[
        Literal["auto", "mvs", "sensor", "network", "none"],
        typer.Option(
            help="Depth of the dense map: mvs, from the images (also in holes of measured depth); sensor or network, "
            "as measured; none, points alone; auto, as measured, else mvs."
        ),
    ] = "auto"
    save_depth: Annotated[bool, typer.Option(help="Write each keyframe's dense depth.")] = False
    save_every_depth: Annotated[
        bool,
        typer.Option(
            help="Write depth and picture of every frame; depth where no sensor has it: what near keyframes saw."
        ),
    ] = False
    assignments: AssignmentsOption = None
    rerun: RerunOption = None
    map_file: Annotated[
        Path | None,
        typer.Option("--map", help="Map of an earlier run (`--save-map`): frames are placed in it, and extend it."),
    ] = None
    localise_only: Annotated[bool, typer.Option(help="Only place frames in the map of `--map`; it stays as it is.")] = (
        False
    )
    save_map: Annotated[Path | None, typer.Option(help="File for the map, so that another run can go on in it.")] = None
    pose_prior: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|recorded",
            help="Poses as a prior of the motion: those that came with the recording (then no ground truth), or a "
            "file's.",
        ),
    ] = None
    resume: ResumeOption = None
    checkpoint_every: Annotated[
        float,
        typer.Option(help="Seconds between two states of the run that are kept for `--resume`; 0: every frame's."),
    ] = EVERY
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="Seed of the samples that robust estimators draw.")
    ] = 0
    quiet: QuietOption = False
    as_json: JsonOption = False


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each parameter of `command` whose type is a dataclass by options, one per field.

    The order of the options is that of the parameters and fields. A parameter that is a group needs no default: its
    fields have theirs.
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
    """Return (width, height) of a text like 640x480; raise InputError for anything else."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise InputError(f"`--size` must be two integers, as in 640x480, got {text!r}") from None
    if min(width, height) < 16 or max(width, height) > 8192:
        raise InputError(f"`--size` must have sides of 16 to 8192 pixels, got {text!r}")
    return width, height
