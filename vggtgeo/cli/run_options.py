"""The options of `vggtgeo run`, each with its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

Provider = Literal["auto", "cuda", "cpu"]
SequenceArgument = Annotated[
    str, typer.Argument(help="Folder of a sequence, video file, ROS bag, webcam:0, or rtsp://...", show_default=False)
]
OutputOption = Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")]
KindOption = Annotated[
    str | None,
    typer.Option(help="Reader: images, rgbd, tum, video, bag, camera, ... (`vggtgeo data list`); found by looking."),
]
StartOption = Annotated[int, typer.Option(min=0, help="First frame.")]
EndOption = Annotated[int | None, typer.Option(min=1, help="Frame to stop before.")]
StrideOption = Annotated[int, typer.Option(min=1, help="Take every n-th frame.")]
IntrinsicsOption = Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels, in place of the folder's.")]
RgbOnlyOption = Annotated[
    bool, typer.Option("--rgb-only/--no-rgb-only", help="Ignore depth images: the scale stays free.")
]
DepthPriorOption = Annotated[
    bool,
    typer.Option(
        "--depth-prior/--no-depth-prior",
        help="Depth holds the estimate; without it, it starts it only: an ablation.",
    ),
]
GlobalOption = Annotated[
    bool,
    typer.Option(
        "--global/--no-global",
        help="One adjustment of the whole map at the end; without it, the sliding window alone: an ablation.",
    ),
]
RefineIntrinsicsOption = Annotated[
    bool | None,
    typer.Option(
        "--refine-intrinsics/--fix-intrinsics",
        help="Whether the last adjustment may move known intrinsics; by default where it pays.",
        show_default=False,
    ),
]
PresetOption = Annotated[
    Literal["classical", "light", "paper"],
    typer.Option(help="Who perceives: classical code, or networks (see `vggtgeo models list`)."),
]
NoLinesOption = Annotated[
    bool, typer.Option("--no-lines/--use-lines", help="Leave out residuals of lines: an ablation.")
]
NoConfidenceOption = Annotated[
    bool, typer.Option("--no-confidence/--use-confidence", help="All matches weigh the same: an ablation.")
]
# Who plays a role, by the names of `vggtgeo.slam.settings.presets.CHOICES`.
PointsOption = Annotated[
    Literal["classical", "orb", "mast3r", "alike", "alike-tiny", "xfeat"] | None,
    typer.Option(help="Who finds and matches points, in place of the preset's choice; classical is SIFT."),
]
LinesOption = Annotated[
    Literal["classical", "letr", "mlsd"] | None,
    typer.Option(help="Who finds line segments, in place of the preset's choice; classical is LSD."),
]
LineMatcherOption = Annotated[
    Literal["classical", "dinov3", "dinov3-small"] | None,
    typer.Option(help="Who matches line segments, in place of the preset's choice; classical is bands of gradients."),
]
ConfidenceOption = Annotated[
    Literal["classical", "dinov3", "dinov3-small"] | None,
    typer.Option(
        help="Whose confidence weighs matches, in place of the preset's choice; classical is the structure tensor."
    ),
]
InitOption = Annotated[
    Literal["classical", "constant-velocity", "vggt"] | None,
    typer.Option(
        help="How a new frame's pose starts, in place of the preset's choice; classical is PnP and two views; "
        "constant-velocity: an ablation."
    ),
]
DepthOption = Annotated[
    Literal["classical", "moge2", "moge2-small"] | None,
    typer.Option(help="Whose depth is used, in place of the preset's choice; classical is the sensor's."),
]
ModelsOption = Annotated[Path | None, typer.Option("--models", help="Folder of the networks' files.")]
CacheOption = Annotated[Path | None, typer.Option("--cache", help="Folder to keep what the networks answer.")]
ProviderOption = Annotated[Provider, typer.Option(help="Where networks run.")]
MemoryOption = Annotated[
    float | None, typer.Option(help="Most GPU memory of each network, GB; has no effect on the CPU.")
]
DenseOption = Annotated[
    Literal["auto", "mvs", "sensor", "network", "none"],
    typer.Option(
        help="Whose depth the map is made of: mvs, the pictures (also in holes of measured depth); sensor or network, "
        "what was measured; none, points alone; auto, what was measured, else the pictures."
    ),
]
SaveDepthOption = Annotated[
    bool, typer.Option("--save-depth/--no-save-depth", help="Write each keyframe's dense depth.")
]
SaveEveryDepthOption = Annotated[
    bool,
    typer.Option(
        "--save-every-depth/--no-save-every-depth",
        help="Write depth and picture of every frame; depth where no sensor has it: what near keyframes saw.",
    ),
]
MapOption = Annotated[
    Path | None,
    typer.Option("--map", help="Map of an earlier run (`--save-map`): frames are placed in it, and extend it."),
]
LocaliseOption = Annotated[
    bool,
    typer.Option(
        "--localise-only/--no-localise-only", help="Only place frames in the map of `--map`; it stays as it is."
    ),
]
SaveMapOption = Annotated[
    Path | None, typer.Option("--save-map", help="File for the map, so that another run can go on in it.")
]
ResumeOption = Annotated[
    bool | None,
    typer.Option(
        "--resume/--no-resume",
        help="Go on with a run into this folder that was killed, or begin anew; without either, such a folder is "
        "refused.",
        show_default=False,
    ),
]
CheckpointOption = Annotated[
    float, typer.Option(help="Seconds between two states of the run that are kept for `--resume`; 0: every frame's.")
]
SeedOption = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the samples that robust estimators draw.")]
RateOption = Annotated[
    float | None,
    typer.Option("--fps", help="Frames a second of a video or a folder of images, in place of what is assumed."),
]
DepthScaleOption = Annotated[
    float | None,
    typer.Option(help="Units a metre of depth files, in place of what their layout says: 1000 is millimetres."),
]
