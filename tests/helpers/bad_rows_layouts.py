"""Rows of the table of bad inputs: times and cameras in the layouts of benchmarks and apps, and where code is kept."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import cv2
import numpy as np
import pytest
import tiny_layouts as layouts
from bad_files import recorded
from bad_row import Row, nothing, read_frames, rows, solve_with
from bad_rows_lists import other_numbers

from vggtgeo.cli.jax_flags import check_cache
from vggtgeo.datasets import open_sequence
from vggtgeo.geometry.point_cloud import PointCloud

UNDERSCORE = "calibration.txt", "5_0 50 20 15"
TRUTHS = '{"fx": 50, "fy": 50, "cx": true, "cy": 15}'
CALIB = "P0: 55 0 20 0 0 55 15 0 0 0 1 0\n"


def cached_in(name: str, folder: Path) -> None:
    """What `vggtgeo run` asks first, where a file lies in the place that the variable names."""
    (folder / "mine").write_text("")
    with pytest.MonkeyPatch.context() as patch:
        for other in ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
            patch.delenv(other, raising=False)
        patch.setenv(name, str(folder / "mine"))
        check_cache("run")


def piped_suite(folder: Path) -> Path:
    """Nobody writes into it."""
    os.mkfifo(folder / "suite.toml")
    return folder / "suite.toml"


def listed_twice(folder: Path) -> None:
    """The first frame once more, at the end."""
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"].append(content["frames"][0])
    (folder / "transforms.json").write_text(json.dumps(content))


def in_microseconds(folder: Path) -> None:
    """EuRoC's list, divided by a thousand."""
    file = next(folder.rglob("cam0/data.csv"))
    lines = [line.split(",") for line in file.read_text().splitlines()]
    file.write_text("\n".join(line[0] if line[0][0] == "#" else f"{int(line[0]) // 1000},{line[1]}" for line in lines))


def realsense(coefficients: list[Any], model: str) -> Callable[[Path], None]:
    """A camera as RealSense's tools write it."""
    fx, fy, cx, cy = layouts.INTRINSICS
    camera = {"fx": fx, "fy": fy, "ppx": cx, "ppy": cy, "coeffs": coefficients, "model": f"distortion.{model}"}
    return bad.write("intrinsic.json", json.dumps(camera))


def copy_of_phone(folder: Path) -> None:
    """What a phone wrote, beside what it was converted to."""
    (folder / "rgb/1.HEIC").write_bytes(b"no")


def pictures_of_phone(folder: Path) -> None:
    """Nobody has converted them."""
    for file in (folder / "rgb").iterdir():
        file.rename(file.with_suffix(".HEIC"))


def in_icloud(folder: Path) -> None:
    """Two of the images are elsewhere, and so are their depths."""
    for number in (1, 2):
        (folder / f"rgb/{number}.png").rename(folder / f"rgb/.{number}.png.icloud")
        (folder / f"depth/{number}.png").unlink()


def in_two_folders(folder: Path) -> None:
    """The images from the second on are in a folder of another name."""
    (folder / "color").mkdir()
    for number in range(1, layouts.COUNT):
        (folder / f"rgb/{number}.png").rename(folder / f"color/{number}.png")
        (folder / f"depth/{number}.png").unlink()


def counted_from_one(folder: Path) -> None:
    """The depths have other numbers than their images."""
    for number in reversed(range(layouts.COUNT)):
        (folder / f"depth/{number}.png").rename(folder / f"depth/{number + 1}.png")


def of_size(rows: int, columns: int, depth: str = "depth") -> Callable[[Path], None]:
    """All depth images of another size."""

    def change(folder: Path) -> None:
        for file in (folder / depth).iterdir():
            cv2.imwrite(str(file), np.full((rows, columns), 2000, np.uint16))

    return change


TIMES = rows(
    "Lists and poses",
    [
        ("KITTI's `times.txt` with 1e300", recorded(layouts.kitti, bad.write("times.txt", "0\n1\n1e300\n"))),
        ("KITTI's `times.txt` without a line", recorded(layouts.kitti, bad.write("times.txt", ""))),
        ("Replica's `traj.txt` without a line", recorded(layouts.replica, bad.write("traj.txt", ""))),
        ("EuRoC's `data.csv` in microseconds", recorded(layouts.euroc, in_microseconds)),
        (
            "Record3D's times, one of 1e300",
            recorded(layouts.record3d, other_numbers("metadata", frameTimestamps=[0.0, 1.0, 1e300])),
        ),
    ],
    call=read_frames,
)
CAMERAS = rows(
    "Calibration",
    [
        ("KITTI's `calib.txt` without `P2`", recorded(layouts.kitti, bad.write("calib.txt", CALIB))),
        ("ScanNet's `_info.txt` without cameras", recorded(layouts.scannet_flat, bad.write("_info.txt", "m_x = 1\n"))),
        (
            "`is_fisheye` beside the model of a pinhole in `transforms.json`",
            recorded(layouts.nerfstudio, other_numbers("transforms.json", is_fisheye=True)),
        ),
        (
            "`is_fisheye` that is a text in `transforms.json`",
            recorded(layouts.nerfstudio, other_numbers("transforms.json", is_fisheye="yes")),
        ),
        (
            "a focal length of 0 in `transforms.json`",
            recorded(layouts.nerfstudio, other_numbers("transforms.json", fl_y=0)),
        ),
        ("a fourth radial coefficient in it", recorded(layouts.nerfstudio, other_numbers("transforms.json", k4=0.1))),
        ("RealSense's distortion in `intrinsic.json`", recorded(layouts.rgbd, realsense([0.1, 0, 0, 0, 0], "brown"))),
        ("a number with a `_` in `calibration.txt`", recorded(layouts.rgbd, bad.write(*UNDERSCORE))),
        ("an image that `transforms.json` lists twice", recorded(layouts.nerfstudio, listed_twice)),
        ("truth values in `intrinsic.json`", recorded(layouts.rgbd, bad.write("intrinsic.json", TRUTHS))),
        ("words for it", recorded(layouts.rgbd, realsense(["none"], ""))),
    ],
    call=read_frames,
)
LEFT_OUT = rows(
    "Images",
    [
        ("AVIF among PNG", recorded(layouts.rgbd, lambda folder: (folder / "rgb/9.avif").write_bytes(b"no"))),
        ("HEIC alone, beside depth", recorded(layouts.rgbd, pictures_of_phone)),
        ("HEIC beside a PNG of the same name", recorded(layouts.rgbd, copy_of_phone)),
        ("pictures that iCloud has not brought", recorded(layouts.rgbd, in_icloud)),
        ("a picture that is still being copied", recorded(layouts.rgbd, bad.write("rgb/9.png.part", "no"))),
        ("a half of the images in another folder", recorded(layouts.rgbd, in_two_folders)),
    ],
    call=read_frames,
)
PAIRS = rows(
    "Depth images",
    [
        ("depth without an image", recorded(layouts.rgbd, lambda folder: (folder / "rgb/2.png").unlink())),
        ("as many as images, counted from 1 where they are from 0", recorded(layouts.rgbd, counted_from_one)),
        ("of one pixel, in `transforms.json`", recorded(layouts.nerfstudio, of_size(1, 1))),
        ("turned, in `transforms.json`", recorded(layouts.nerfstudio, of_size(20, 15))),
        ("turned, of ARKit", recorded(layouts.arkit, of_size(20, 15, "lowres_depth"))),
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
        ("a volume with a NaN", scanned(axis_min=float("nan"))),
        ("a volume of two corners", scanned(bounding_polygon=[[0, 0, 0], [1, 0, 1]])),
        ("a volume of words", scanned(bounding_polygon=[["a", "b", "c"]] * 3)),
        ("a volume elsewhere", scanned(axis_min=100.0, axis_max=101.0)),
        ("a scan that was cut off", cut_scan),
    ],
    call=lambda folder: open_sequence(folder).scanned_points(),  # type: ignore[attr-defined]
)
ENVIRONMENT = rows(
    "Environment",
    [
        (
            "`JAX_COMPILATION_CACHE_DIR` that is a file",
            nothing,
            {"call": lambda made: cached_in("JAX_COMPILATION_CACHE_DIR", made)},
        ),
        (
            "a file in the place of the folder where code is kept",
            nothing,
            {"call": lambda made: cached_in("XDG_CACHE_HOME", made)},
        ),
    ],
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
