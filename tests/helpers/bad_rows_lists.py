"""Rows of the table of bad inputs: lists of files and times, poses, calibration files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import tiny_layouts as layouts
from bad_files import recorded
from bad_row import Row, read_frames, rows
from bad_rows_files import OPENED


def other_numbers(name: str, **values: Any) -> Callable[[Path], None]:
    """A file of JSON, beside the recording or in it, whose objects have other values under these names."""

    def change(folder: Path) -> None:
        file = next(place for place in (folder / name, folder.parent / name) if place.is_file())
        content = json.loads(file.read_text())
        content.get("camera", content).update(values)
        file.write_text(json.dumps(content))

    return change


def backwards(name: str, head: int = 0) -> Callable[[Path], None]:
    """A list from its last line to its first, the latter twice; head: lines that stay the first."""

    def change(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        turned = lines[:head] + lines[: head - 1 if head else None : -1] + lines[head : head + 1]
        (folder / name).write_text("\n".join(turned) + "\n")

    return change


def later_images(folder: Path) -> None:
    """A room's images from the second on, and the pose of its first one."""
    (folder / "results/frame000000.jpg").unlink()
    (folder / "traj.txt").write_text((folder / "traj.txt").read_text().splitlines()[0] + "\n")


def listed(change: Callable[[str], str], file: str = "rgb.txt") -> Callable[[Path], Path]:
    """A TUM folder with a changed list."""
    return bad.rgbd(lambda folder: (folder / file).write_text(change((folder / file).read_text())))


def pipe_in_list(folder: Path) -> None:
    """The list names a pipe that nobody writes into."""
    os.mkfifo(folder / "pipe.png")
    (folder / "rgb.txt").write_text("9.0 pipe.png\n" + (folder / "rgb.txt").read_text())


def calibrated(content: str | bytes) -> Callable[[Path], Path]:
    """Good images with this `calibration.txt`."""
    return lambda folder: bad.frames(folder / "frames", calibration=content)


LISTS = rows(
    "Lists and poses",
    [
        ("a pipe that nobody writes into", bad.rgbd(pipe_in_list)),
        ("times in nanoseconds", listed(lambda text: "1403636579763555584 rgb/10.000000.png\n")),
        ("poses of ARKitScenes out of order", recorded(layouts.arkit, backwards("lowres_wide.traj")), OPENED),
        ("poses of Stray Scanner out of order", recorded(layouts.stray, backwards("odometry.csv", 1)), OPENED),
        ("Stray Scanner without its poses", recorded(layouts.stray, lambda made: (made / "odometry.csv").unlink())),
        ("poses of Replica that are cut before the images", recorded(layouts.replica, later_images), OPENED),
    ],
    call=read_frames,
)
CALIBRATION = rows(
    "Calibration",
    [
        ("Replica's, of other images", recorded(layouts.replica, other_numbers("cam_params.json", w=1200, h=680))),
    ],
    call=read_frames,
)
ALL_LISTS: list[Row] = [*LISTS, *CALIBRATION]
