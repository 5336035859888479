"""The options of `vggtgeo run` in groups, each option with its help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from vggtgeo.cli.options import AssignmentsOption, JsonOption, QuietOption, RerunOption
from vggtgeo.results.output_checks import EVERY

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
