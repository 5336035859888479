"""Rows of the table of bad inputs: command lines, settings, networks and environments."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import bad_files as bad
import numpy as np
import pytest
from bad_row import Row, good, line, nothing, rows, run_with
from bad_rows_outputs import OUTPUT, linked_to_itself
from bad_rows_results import RESULTS, TRAJECTORIES, folder_of_run, summary_of

from vggtgeo.cli.address_space import check_address_space
from vggtgeo.export import FORMATS, export, formats
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.jax_environment import cache_folder
from vggtgeo.io.locks import locked


def flags(*words: Any) -> dict[str, Any]:
    """`vggtgeo run` on good images with these flags."""
    return {"argv": run_with(*words)}


def settings(content: str | bytes) -> dict[str, Any]:
    """`vggtgeo run` on good images with a settings file."""

    def make(folder: Path) -> Path:
        bad.file("run.toml", content)(folder)
        return good(folder)

    return {"make": make, "argv": lambda made: [*run_with("--settings", made.parent / "run.toml")(made)]}


def network(content: bytes | None, *words: Any) -> dict[str, Any]:
    """`vggtgeo models verify` of a file."""
    make = nothing if content is None else bad.file("net.onnx", content)
    return {
        "make": make,
        "argv": lambda made: ["models", "verify", made if content is not None else made / "net.onnx", *words],
    }


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


def verify(made: Path) -> Any:
    """`vggtgeo models verify`."""
    return ["models", "verify", made]


def simulated(*words: str) -> Any:
    """`vggtgeo simulate` into a new folder."""
    return lambda made: ["simulate", "room", "-o", made / "new", *words]


IMPORTS = 3.0
"""Slack of a command that brings JAX before it can read its input."""


def benched(suite: str) -> Any:
    """`vggtgeo bench` into a new folder; `{}` is where the suite's file lies."""
    return lambda made: ["bench", suite.format(made), "-o", made / "new"]


def suite(content: str) -> Any:
    """Makes a suite."""
    return lambda folder: bad.file("suite.toml", content)(folder).parent


SEQUENCES = """title = "t"
[[sequence]]
name = "walk"
simulate = {frames = 4}
[[sequence]]
name = "Walk"
simulate = {frames = 4}
[[setting]]
name = "full"
"""


def without_home(folder: Path) -> None:
    """No home folder, and one that cannot be written: there is no cache, and that is all."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("HOME", "XDG_CACHE_HOME"):
            patch.delenv(name, raising=False)
        patch.setattr(os.path, "expanduser", lambda path: path)
        assert cache_folder() is None
        (folder / "file").write_text("")
        patch.setenv("XDG_CACHE_HOME", str(folder / "file"))
        assert cache_folder() is None


def limited(gigabytes: float) -> None:
    """What `vggtgeo run` asks first, with so large an address space."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("resource.getrlimit", lambda kind: (int(gigabytes * 1e9), -1))
        check_address_space("run")


def run_without_points(folder: Path) -> Path:
    """The folder of a run that never began."""
    PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)).save_ply(folder / "map.ply")
    return folder_of_run(summary_of("failed", "no map was ever started"))(folder)


def run_without_surfaces(folder: Path) -> Path:
    """The folder of a run with `--dense none`."""
    return folder_of_run(summary_of("good"))(folder)


def run_of_a_continent(folder: Path) -> Path:
    """The folder of a run whose map is 10,000 km across."""
    PointCloud(np.diag([1e7, 1.0, 1.0]), np.zeros((3, 3), np.uint8)).save_ply(folder / "map.ply")
    return folder_of_run(summary_of("good"))(folder)


def export_onto_full_disk(made: Path) -> None:
    """An export that finds no space for its first file."""

    def full(source: Path, target: Path) -> dict[str, float]:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target / "trajectory.txt"))

    with patch.dict(FORMATS, tum=full):
        export(made, "tum", made / "out")


def export_beside(made: Path) -> None:
    """An export while another puts its files into the same folder, and does not come to an end."""
    (made / "out").mkdir()
    with (
        patch.object(formats, "_TURNS", 1),
        patch.dict(FORMATS, tum=lambda source, target: {}),
        locked(made / "out/.vggtgeo-export.lock"),
    ):
        export(made, "tum", made / "out")


def killed_run(folder: Path) -> Path:
    """A folder where the first run was killed."""
    (folder / "unfinished").mkdir()
    (folder / "unfinished/checkpoint.npz").write_bytes(b"")
    return folder


def exported_over(folder: Path) -> Path:
    """A run's folder, and one with a trajectory of somebody else."""
    (folder / "run").mkdir()
    (folder / "mine").mkdir()
    folder_of_run(summary_of("good"))(folder / "run")
    for name in ("trajectory", "keyframes"):
        bad.walk(folder / f"run/{name}.txt", 0)
    bad.walk(folder / "mine/trajectory.txt", 1)
    return folder


def run_and_link(folder: Path) -> Path:
    """A run's folder, in which a link to itself lies."""
    (folder / "out").symlink_to("out")
    return Path(folder_of_run(summary_of("good"))(folder))


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
        ("`--set` of a setting that is none", good, flags("--set", "tracking.least_inlier=3")),
        ("`--set` of a wrong value", good, flags("--set", "tracking.least_inliers=-3")),
        ("`--set` of a number of 5000 digits", good, flags("--set", "tracking.least_inliers=1" + "0" * 5000)),
        ("`--set` of a number beyond all numbers", good, flags("--set", "weights.confidence_gain=1" + "0" * 400)),
        ("`--set` of ten thousand brackets", good, flags("--set", "tracking.least_inliers=" + "[" * 10_000)),
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
        ("`--set` of two lines", good, flags("--set", "tracking.least_inliers=5\nkeyframes.keyframe_distance=1")),
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
        ("an unknown group", None, settings("[trackin]\nleast_inliers = 3")),
        ("ten thousand brackets", None, settings("a = " + "[" * 10_000)),
        ("a number of 5000 digits", None, settings("stride = 1" + "0" * 5000)),
        ("a number for a group", None, settings("tracking = 5")),
        ("a list of tables for a group", None, settings("[[tracking]]\nleast_inliers = 3")),
        ("a setting outside its group", None, settings("least_inliers = 5")),
        ("a window of 10^12 keyframes", None, settings("window.size = 999999999999")),
        ("a kernel of infinite width", None, settings("window.kernel = 'cauchy 1e400'")),
        ("empty text for the output folder", None, settings("output = ''")),
        ("a key twice", None, settings("stride = 1\nstride = 2")),
        ("a zero byte in a name", None, settings('output = "a\\u0000b"')),
        ("two byte order marks", None, settings(2 * b"\xef\xbb\xbf" + b"stride = 2")),
        ("a date for a number", None, settings("stride = 2024-01-01")),
    ],
)


OTHERS = rows(
    "Other commands",
    [
        ("a command that is none", nothing, {"argv": line("solv")}),
        ("a flag that is none", nothing, {"argv": line("run", "--bad")}),
        ("`demo --frames 0`", nothing, {"argv": line("demo", "--frames", "0")}),
        (
            "`export` over files that no export wrote",
            exported_over,
            {"call": lambda made: export(made / "run", "tum", made / "mine")},
        ),
        (
            "`export` into a folder where another export goes on",
            folder_of_run(summary_of("good")),
            {"call": export_beside},
        ),
        (
            "`export` of a run that was killed",
            killed_run,
            {"argv": lambda made: ["export", made, "--to", "ply"]},
        ),
        (
            "`view` of a run that was killed",
            killed_run,
            {"argv": lambda made: ["view", made, "--rerun", made / "run.rrd"]},
        ),
        ("`export` onto a full disk", folder_of_run(summary_of("good")), {"call": export_onto_full_disk}),
        (
            "`export` onto a link to itself",
            run_and_link,
            {"call": lambda made: export(made, "tum", made / "out")},
        ),
        (
            "`export` of a run without points",
            run_without_points,
            {"argv": lambda made: ["export", made, "--to", "ply"]},
        ),
        (
            "`export --to glb` of a run with `--dense none`",
            run_without_surfaces,
            {"argv": lambda made: ["export", made, "--to", "glb"]},
        ),
        ("`export` of a folder that is no run", good, {"argv": lambda made: ["export", made, "--to", "ply"]}),
        ("`export --to` a format that is none", good, {"argv": lambda made: ["export", made, "--to", "xyz"]}),
        (
            "`export` into the run itself",
            run_without_surfaces,
            {"argv": lambda made: ["export", made, "--to", "tum", "-o", made]},
        ),
        (
            "`export` among the images of the run",
            run_without_surfaces,
            {"argv": lambda made: ["export", made, "--to", "tum", "-o", made / "images" / "new"]},
        ),
        (
            "`export` of a run without its poses",
            run_without_surfaces,
            {"argv": lambda made: ["export", made, "--to", "tum"]},
        ),
        (
            "`export --to las` of a map of 10,000 km",
            run_of_a_continent,
            {"argv": lambda made: ["export", made, "--to", "las"]},
        ),
        ("`demo` of 10^20 frames", nothing, {"argv": line("demo", "--frames", "1" + "0" * 20)}),
        ("`demo --frames many`", nothing, {"argv": line("demo", "--frames", "many")}),
        ("`demo` of a scene that is none", nothing, {"argv": line("demo", "--scene", "moon")}),
        ("`simulate --frames 0`", nothing, {"argv": simulated("--frames", "0")}),
        ("`simulate --size 640`", nothing, {"argv": simulated("--size", "640")}),
        ("`simulate --size 4x4`", nothing, {"argv": simulated("--size", "4x4")}),
        ("`simulate --rate 0`", nothing, {"argv": simulated("--rate", "0")}),
        ("`simulate --rate 1e-320`", nothing, {"argv": simulated("--rate", "1e-320")}),
        ("`simulate --speed 1e300`", nothing, {"argv": simulated("--speed", "1e300")}),
        ("`simulate --blur -1`", nothing, {"argv": simulated("--blur", "-1")}),
        ("`simulate --readout` of ten seconds", nothing, {"argv": simulated("--readout", "10")}),
        ("`simulate --blur` of a second", nothing, {"argv": simulated("--blur", "1")}),
        ("`simulate --speed nan`", nothing, {"argv": simulated("--speed", "nan")}),
        ("`view` of a folder that is not there", nothing, {"argv": line("view", "no/such/run")}),
        ("`view` of a folder that is no run's", nothing, {"argv": lambda made: ["view", made]}),
        ("`view --rerun` of an address", nothing, {"argv": lambda made: ["view", made, "--rerun", "http://a/b.rrd"]}),
        ("`view --rerun text.txt`", nothing, {"argv": lambda made: ["view", made, "--rerun", "text.txt"]}),
        ("`bench` of a suite that is none", nothing, {"argv": benched("no-such-suite"), "slack": IMPORTS}),
        (
            "`bench` of a suite that is no TOML",
            suite("sequences: 2"),
            {"argv": benched("{}/suite.toml"), "slack": IMPORTS},
        ),
        (
            "`bench --sequences` of one that is none",
            nothing,
            {"argv": lambda made: ["bench", "quick", "-o", made / "new", "--sequences", "x"], "slack": IMPORTS},
        ),
        (
            "`bench` into the root of the file system",
            nothing,
            {"argv": line("bench", "quick", "-o", "/"), "slack": IMPORTS},
        ),
        (
            "`bench` into the folder of a run",
            bad.file("report.html", "of a run"),
            {"argv": lambda made: ["bench", "quick", "-o", made.parent], "slack": IMPORTS},
        ),
        (
            "`bench` of two sequences whose names differ in capitals",
            suite(SEQUENCES),
            {"argv": benched("{}/suite.toml"), "slack": IMPORTS},
        ),
        (
            "`bench` of a suite without sequences",
            suite("name = 'mine'"),
            {"argv": benched("{}/suite.toml"), "slack": IMPORTS},
        ),
    ],
)


NETWORKS = rows(
    "Network files",
    [
        ("a file that is not there", None, network(None)),
        ("a folder", nothing, {"argv": lambda made: ["models", "verify", made]}),
        ("an empty file", None, network(b"")),
        ("a PyTorch checkpoint", None, network(b"PK\x03\x04" + b"\0" * 99)),
        ("a pickle", None, network(b"\x80\x02}q\0." + b"\0" * 99)),
        ("a Git LFS pointer", None, network(b"version https://git-lfs.github.com/spec/v1\n")),
        ("a web page", None, network(b"<!DOCTYPE html><html></html>")),
        ("random bytes", None, network(bytes(range(256)) * 20)),
        ("20 GB of zeros", lambda folder: bad.lengthened(folder / "net.onnx"), {"argv": verify}),
        ("a network that is none", None, network(b"\x08\x09", "--network", "resnet")),
        ("`models fetch` of a network that is none", nothing, {"argv": line("models", "fetch", "resnet")}),
    ],
    slack=3.0,
)


ENVIRONMENT = rows(
    "Environment",
    [
        ("no home folder, or one that cannot be written: nothing is cached", nothing, {"call": without_home}),
        ("`ulimit -v` that is too small", nothing, {"call": lambda made: limited(2.5)}),
        ("`ulimit -v` that is small", nothing, {"call": lambda made: limited(4.0)}),
    ],
)


COMMANDS: list[Row] = [*RUN, *SETTINGS, *OUTPUT, *OTHERS, *TRAJECTORIES, *NETWORKS, *RESULTS, *ENVIRONMENT]
