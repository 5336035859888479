"""Rows of the table of bad inputs: times and cameras in the layouts of benchmarks and apps, and where code is kept."""

from __future__ import annotations

import os
from pathlib import Path

import bad_files as bad
import pytest
import tiny_layouts as layouts
from bad_row import Row, nothing, read_frames, rows, solve_with
from bad_rows_strangers import other_numbers, recorded

from vggtgeo.cli.jax_flags import check_cache

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


TIMES = rows(
    "Lists and poses",
    [
        ("KITTI's `times.txt` with 1e300", recorded(layouts.kitti, bad.write("times.txt", "0\n1\n1e300\n"))),
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
    ],
    call=read_frames,
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
LAYOUTS: list[Row] = [*TIMES, *CAMERAS, *ENVIRONMENT, *SOLVE, *SUITES]
