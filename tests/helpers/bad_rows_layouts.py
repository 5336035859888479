"""Rows of the table of bad inputs: times and cameras in the layouts of benchmarks and apps, and where code is kept."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
import tiny_layouts as layouts
from bad_files import recorded
from bad_row import Row, read_frames, rows, solve_with
from bad_rows_lists import other_numbers

from vggtgeo.datasets import open_sequence
from vggtgeo.geometry.point_cloud import PointCloud


def piped_suite(folder: Path) -> Path:
    """Nobody writes into it."""
    os.mkfifo(folder / "suite.toml")
    return folder / "suite.toml"


def realsense(coefficients: list[Any], model: str) -> Callable[[Path], None]:
    """A camera as RealSense's tools write it."""
    fx, fy, cx, cy = layouts.INTRINSICS
    camera = {"fx": fx, "fy": fy, "ppx": cx, "ppy": cy, "coeffs": coefficients, "model": f"distortion.{model}"}
    return bad.write("intrinsic.json", json.dumps(camera))


TIMES = rows(
    "Lists and poses",
    [
        ("KITTI's `times.txt` without a line", recorded(layouts.kitti, bad.write("times.txt", ""))),
        ("Replica's `traj.txt` without a line", recorded(layouts.replica, bad.write("traj.txt", ""))),
    ],
    call=read_frames,
)
CAMERAS = rows(
    "Calibration",
    [
        (
            "a focal length of 0 in `transforms.json`",
            recorded(layouts.nerfstudio, other_numbers("transforms.json", fl_y=0)),
        ),
        ("RealSense's distortion in `intrinsic.json`", recorded(layouts.rgbd, realsense([0.1, 0, 0, 0, 0], "brown"))),
        ("words for it", recorded(layouts.rgbd, realsense(["none"], ""))),
    ],
    call=read_frames,
)
LEFT_OUT = rows(
    "Images",
    [
        ("AVIF among PNG", recorded(layouts.rgbd, lambda folder: (folder / "rgb/9.avif").write_bytes(b"no"))),
    ],
    call=read_frames,
)
PAIRS = rows(
    "Depth images",
    [
        ("depth without an image", recorded(layouts.rgbd, lambda folder: (folder / "rgb/2.png").unlink())),
    ],
    call=read_frames,
)


def scanned(**crop: Any) -> Callable[[Path], Path]:
    """A scene of Tanks and Temples with a scan, and another volume in which it counts."""

    def make(folder: Path) -> Path:
        made = layouts.tanks(folder / "Ignatius")
        points = np.random.default_rng(0).random((50, 3))
        PointCloud(points, np.zeros((50, 3), np.uint8)).save_ply(made / "Ignatius.ply")
        volume = json.loads((made / "Ignatius.json").read_text())
        (made / "Ignatius.json").write_text(json.dumps(volume | crop))
        return made

    return make


def cut_scan(folder: Path) -> Path:
    """Half a scan."""
    made = scanned()(folder)
    content = (made / "Ignatius.ply").read_bytes()
    (made / "Ignatius.ply").write_bytes(content[: len(content) // 2])
    return made


SCANS = rows(
    "`vggtgeo bench`: scans",
    [
        ("a volume without an axis", scanned(orthogonal_axis="")),
        ("a volume of two axes", scanned(orthogonal_axis="XY")),
        ("a volume upside down", scanned(axis_min=1.0, axis_max=-1.0)),
        ("a volume of words", scanned(bounding_polygon=[["a", "b", "c"]] * 3)),
        ("a volume elsewhere", scanned(axis_min=100.0, axis_max=101.0)),
        ("a scan that was cut off", cut_scan),
    ],
    call=lambda folder: open_sequence(folder).scanned_points(),  # type: ignore[attr-defined]
)
ENVIRONMENT = rows(
    "Environment",
    [],
)
SOLVE = rows(
    "`vggtgeo solve`",
    [("`--repeat` of 10^20", bad.problem(), {"argv": solve_with("--repeat", "100000000000000000000")})],
)
SUITES = rows(
    "Other commands",
    [
        (
            "`bench` of a suite that is a pipe",
            piped_suite,
            {"argv": lambda made: ["bench", made, "-o", made.parent / "o"], "slack": 3.0},
        )
    ],
)
LAYOUTS: list[Row] = [*TIMES, *CAMERAS, *LEFT_OUT, *PAIRS, *SCANS, *ENVIRONMENT, *SOLVE, *SUITES]
