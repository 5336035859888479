"""Rows of the table of bad inputs: `bench`, `export`, `simulate` and what else there is beside `run`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
from bad_row import good, line, nothing, rows
from bad_rows_results import folder_of_run, summary_of

from vggtgeo.export import export
from vggtgeo.geometry.point_cloud import PointCloud


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


def run_without_points(folder: Path) -> Path:
    """The folder of a run that never began."""
    PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)).save_ply(folder / "map.ply")
    return folder_of_run(summary_of("failed", "no map was ever started"))(folder)


def run_without_surfaces(folder: Path) -> Path:
    """The folder of a run with `--dense none`."""
    return folder_of_run(summary_of("good"))(folder)


def exported_over(folder: Path) -> Path:
    """A run's folder, and one with a trajectory of somebody else."""
    (folder / "run").mkdir()
    (folder / "mine").mkdir()
    folder_of_run(summary_of("good"))(folder / "run")
    for name in ("trajectory", "keyframes"):
        bad.walk(folder / f"run/{name}.txt", 0)
    bad.walk(folder / "mine/trajectory.txt", 1)
    return folder


OTHERS = rows(
    "Other commands",
    [
        ("a command that is none", nothing, {"argv": line("solv")}),
        (
            "`export` over files that no export wrote",
            exported_over,
            {"call": lambda made: export(made / "run", "tum", made / "mine")},
        ),
        (
            "`export` of a run without points",
            run_without_points,
            {"argv": lambda made: ["export", made, "--to", "ply"]},
        ),
        ("`export` of a folder that is no run", good, {"argv": lambda made: ["export", made, "--to", "ply"]}),
        (
            "`export` into the run itself",
            run_without_surfaces,
            {"argv": lambda made: ["export", made, "--to", "tum", "-o", made]},
        ),
        ("`simulate --size 640`", nothing, {"argv": simulated("--size", "640")}),
        ("`simulate --rate 0`", nothing, {"argv": simulated("--rate", "0")}),
        ("`view` of a folder that is not there", nothing, {"argv": line("view", "no/such/run")}),
        ("`view` of a folder that is no run's", nothing, {"argv": lambda made: ["view", made]}),
        ("`bench` of a suite that is none", nothing, {"argv": benched("no-such-suite"), "slack": IMPORTS}),
        (
            "`bench` of a suite that is no TOML",
            suite("sequences: 2"),
            {"argv": benched("{}/suite.toml"), "slack": IMPORTS},
        ),
        (
            "`bench` of a suite without sequences",
            suite("name = 'mine'"),
            {"argv": benched("{}/suite.toml"), "slack": IMPORTS},
        ),
    ],
)
