"""Rows of the table of bad inputs: `vggtgeo run`, and settings files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
from bad_row import good, line, nothing, rows, run_with


def flags(*words: Any) -> dict[str, Any]:
    """`vggtgeo run` on good images with these flags."""
    return {"argv": run_with(*words)}


def settings(content: str | bytes) -> dict[str, Any]:
    """`vggtgeo run` on good images with a settings file."""

    def make(folder: Path) -> Path:
        bad.file("run.toml", content)(folder)
        return good(folder)

    return {"make": make, "argv": lambda made: [*run_with("--settings", made.parent / "run.toml")(made)]}


def onto(name: str, flag: str) -> Any:
    """`vggtgeo run` on good images, with a flag that names a file of the user."""

    def argv(made: Path) -> Any:
        if name.endswith(".npz"):  # an archive, as a map is one, too
            np.savez(made.parent / name, measured=np.zeros(3))
        else:
            (made.parent / name).write_text("of the user")
        return run_with(flag, made.parent / name)(made)

    return argv


RUN = rows(
    "`vggtgeo run`",
    [
        ("no path", nothing, {"argv": line("run")}),
        ("an empty path", nothing, {"argv": line("run", "")}),
        ("a path that is not there", nothing, {"argv": line("run", "no/such/clip")}),
        ("`--stride 0`", good, flags("--stride", "0")),
        ("`--start 2 --end 1`", good, flags("--start", "2", "--end", "1")),
        ("`--start` behind the last frame", good, flags("--start", "100")),
        ("three intrinsics", good, flags("--intrinsics", "1,2,3")),
        ("a negative focal length", good, flags("--intrinsics", "-50,50,32,24")),
        ("a focal length in metres", good, flags("--intrinsics", "0.001,0.001,32,24")),
        ("`--map` that is no map", good, flags("--map", __file__)),
        ("`--localise-only` without `--map`", good, flags("--localise-only")),
        ("`--save-map` onto a file that is no map", good, {"argv": onto("mine.npz", "--save-map")}),
        ("`--fps` where frames have times", bad.rgbd(lambda folder: None), flags("--fps", "5")),
        ("a preset whose networks are not there", good, flags("--preset", "light", "--models", "no")),
        ("`--set` of a setting that is none", good, flags("--set", "keyframes.min_inlier=3")),
        ("`--set` of a wrong value", good, flags("--set", "keyframes.min_inliers=-3")),
        ("`--rerun` onto a file that is no recording", good, {"argv": onto("mine.rrd", "--rerun")}),
        ("`--depth-scale 0`", good, flags("--depth-scale", "0")),
        ("a reader that is none", good, flags("--kind", "photos")),
        ("the reader of videos on a folder", good, flags("--kind", "video")),
    ],
)


SETTINGS = rows(
    "Settings files",
    [
        ("a file that is not there", good, flags("--settings", "no.toml")),
        ("a device that never ends", good, flags("--settings", "/dev/zero")),
        ("no TOML", None, settings("stride: 2")),
        ("an unknown key", None, settings("strid = 2")),
        ("text for a number", None, settings("stride = 'two'")),
        ("a number out of range", None, settings("stride = 0")),
    ],
)
