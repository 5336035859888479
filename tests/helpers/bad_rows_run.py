"""Rows of the table of bad inputs: `vggtgeo run`, and settings files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
from bad_row import good, line, nothing, rows, run_with
from bad_rows_outputs import linked_to_itself


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


def below_output(flag: str, name: str) -> Callable[[Any], list[Any]]:
    """A run with a file below its own output."""
    return lambda made: [*run_with(flag, made.parent / "out" / name)(made)]


def beside_made(flag: str, name: str) -> Any:
    """`vggtgeo run` on good images, a flag with the name of something beside them."""
    return lambda made: ["run", made, "-o", made.parent / "out", flag, made.parent / name]


def looped(folder: Path) -> Path:
    """Two links to each other."""
    (folder / "a").symlink_to(folder / "b")
    (folder / "b").symlink_to(folder / "a")
    return folder / "a"


RUN = rows(
    "`vggtgeo run`",
    [
        ("no path", nothing, {"argv": line("run")}),
        ("an empty path", nothing, {"argv": line("run", "")}),
        ("an empty `-o`", good, {"argv": lambda made: ["run", made, "-o", ""]}),
        ("a path that is not there", nothing, {"argv": line("run", "no/such/clip")}),
        ("`--stride 0`", good, flags("--stride", "0")),
        ("`--stride -2`", good, flags("--stride", "-2")),
        ("`--start -1`", good, flags("--start", "-1")),
        ("`--end 0`", good, flags("--end", "0")),
        ("`--end -5`", good, flags("--end", "-5")),
        ("`--start 2 --end 1`", good, flags("--start", "2", "--end", "1")),
        ("`--start` behind the last frame", good, flags("--start", "100")),
        ("three intrinsics", good, flags("--intrinsics", "1,2,3")),
        ("intrinsics that are words", good, flags("--intrinsics", "a,b,c,d")),
        ("intrinsics with NaN", good, flags("--intrinsics", "nan,50,32,24")),
        ("a negative focal length", good, flags("--intrinsics", "-50,50,32,24")),
        ("a focal length in metres", good, flags("--intrinsics", "0.001,0.001,32,24")),
        ("a principal point far outside", good, flags("--intrinsics", "55,55,3200,24")),
        ("`--fps 0`", good, flags("--fps", "0")),
        ("`--fps nan`", good, flags("--fps", "nan")),
        ("`--checkpoint-every -1`", good, flags("--checkpoint-every", "-1")),
        ("`--map` that is not there", good, flags("--map", "no.map")),
        ("`--map` that is no map", good, flags("--map", __file__)),
        ("`--localise-only` without `--map`", good, flags("--localise-only")),
        ("`--save-map` of a folder", good, flags("--save-map", "/")),
        ("`--save-map` onto a file that is no map", good, {"argv": onto("mine.npz", "--save-map")}),
        (
            "`--save-map` onto a result of the run",
            good,
            {"argv": lambda made: [*run_with("--save-map", made.parent / "out/trajectory.txt")(made)]},
        ),
        ("`--fps` where frames have times", bad.rgbd(lambda folder: None), flags("--fps", "5")),
        ("`--provider cuda` without a GPU", good, flags("--provider", "cuda")),
        ("`--provider tpu`", good, flags("--provider", "tpu")),
        ("a preset that is none", good, flags("--preset", "papers")),
        ("a preset whose networks are not there", good, flags("--preset", "light", "--models", "no")),
        ("`--memory-limit-gb 0`", good, flags("--memory-limit-gb", "0")),
        ("`--points` of somebody who finds lines", good, flags("--points", "mlsd")),
        ("`--lines mlsd --no-lines`", good, flags("--lines", "mlsd", "--no-lines")),
        ("`--dense network` without a network", good, flags("--dense", "network")),
        ("`--save-depth --dense none`", good, flags("--save-depth", "--dense", "none")),
        ("`--set` without a value", good, flags("--set", "nonsense")),
        ("`--set` of a setting that is none", good, flags("--set", "keyframes.min_inlier=3")),
        ("`--set` of a wrong value", good, flags("--set", "keyframes.min_inliers=-3")),
        ("`--set` of a number of 5000 digits", good, flags("--set", "keyframes.min_inliers=1" + "0" * 5000)),
        ("`--set` of a number beyond all numbers", good, flags("--set", "weights.confidence_gain=1" + "0" * 400)),
        ("`--set` of ten thousand brackets", good, flags("--set", "keyframes.min_inliers=" + "[" * 10_000)),
        ("`--rerun` onto a file that is no recording", good, {"argv": onto("mine.rrd", "--rerun")}),
        ("`--rerun` to a text file", good, flags("--rerun", "run.txt")),
        ("`--seed -1`", good, flags("--seed", "-1")),
        ("`--seed` beyond 32 bits", good, flags("--seed", "99999999999")),
        ("`--depth-scale 0`", good, flags("--depth-scale", "0")),
        ("a reader that is none", good, flags("--kind", "photos")),
        ("`--memory-limit-gb 1e400`", good, flags("--memory-limit-gb", "1e400")),
        ("`--fps 1e-320`", good, flags("--fps", "1e-320")),
        ("`--fps 1e300`", good, flags("--fps", "1e300")),
        ("`--start 0x1`", good, flags("--start", "0x1")),
        ("`--stride 1e0`", good, flags("--stride", "1e0")),
        ("`--intrinsics` with 1e400", good, flags("--intrinsics", "1e400,55,31.5,23.5")),
        ("`--depth-scale 1e-300`", bad.rgbd(lambda folder: None), flags("--depth-scale", "1e-300")),
        ("a path of 100,000 letters", nothing, {"argv": line("run", 100_000 * "x")}),
        ("`--depth-scale 1e400`", good, flags("--depth-scale", "1e400")),
        ("`--save-map` onto a device", good, flags("--save-map", "/dev/full")),
        ("`--save-map` where nothing can be written", good, flags("--save-map", "/proc/x.map")),
        (
            "`--save-map` in the place of the run's folder",
            good,
            {"argv": lambda made: [*run_with("--save-map", made.parent / "out")(made)]},
        ),
        ("`--save-map` among the run's pictures", good, {"argv": below_output("--save-map", "images/x.map")}),
        ("`--rerun` among the run's pictures", good, {"argv": below_output("--rerun", "images/x.rrd")}),
        ("`--set` of two lines", good, flags("--set", "keyframes.min_inliers=5\nkeyframes.keyframe_distance=1")),
        ("the home folder of somebody unknown", nothing, {"argv": line("run", "~no-such-user/clip")}),
        ("two paths", good, {"argv": lambda made: ["run", made, made]}),
        ("`-` for standard input", nothing, {"argv": line("run", "-")}),
        ("a link to itself", looped, {"argv": lambda made: ["run", made]}),
        ("a webcam of a number that no computer has", nothing, {"argv": line("run", "webcam:99999999999")}),
        ("`--rerun` onto a link to itself", linked_to_itself("run.rrd"), {"argv": beside_made("--rerun", "run.rrd")}),
        ("the reader of videos on a folder", good, flags("--kind", "video")),
        ("the reader of folders on a file", bad.file("clip.mp4", b"no"), flags("--kind", "tum")),
    ],
)


SETTINGS = rows(
    "Settings files",
    [
        ("a file that is not there", good, flags("--settings", "no.toml")),
        ("a device that never ends", good, flags("--settings", "/dev/zero")),
        ("no TOML", None, settings("stride: 2")),
        ("not UTF-8", None, settings(b"path = '\xff\xfe'")),
        ("an unknown key", None, settings("strid = 2")),
        ("text for a number", None, settings("stride = 'two'")),
        ("a number out of range", None, settings("stride = 0")),
        ("an unknown group", None, settings("[keyframe]\nmin_inliers = 3")),
        ("ten thousand brackets", None, settings("a = " + "[" * 10_000)),
        ("a number of 5000 digits", None, settings("stride = 1" + "0" * 5000)),
        ("a number for a group", None, settings("keyframes = 5")),
        ("a list of tables for a group", None, settings("[[keyframes]]\nmin_inliers = 3")),
        ("a setting outside its group", None, settings("min_inliers = 5")),
        ("a window of 10^12 keyframes", None, settings("window.size = 999999999999")),
        ("a kernel of infinite width", None, settings("window.kernel = 'cauchy 1e400'")),
        ("empty text for the output folder", None, settings("output = ''")),
        ("a key twice", None, settings("stride = 1\nstride = 2")),
        ("a zero byte in a name", None, settings('output = "a\\u0000b"')),
        ("two byte order marks", None, settings(2 * b"\xef\xbb\xbf" + b"stride = 2")),
        ("a date for a number", None, settings("stride = 2024-01-01")),
    ],
)
