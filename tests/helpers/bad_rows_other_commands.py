"""Rows of the table of bad inputs: `bench`, `export`, `simulate` and what else there is beside `run`."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any
from unittest.mock import patch

import bad_files as bad
import numpy as np
from bad_row import good, line, nothing, rows
from bad_rows_results import folder_of_run, summary_of

from vggtgeo.export import FORMATS, export, formats
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.locks import locked


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
        patch.object(formats, "_TIMEOUT", 0.1),
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
