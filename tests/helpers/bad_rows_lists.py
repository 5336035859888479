"""Rows of the table of bad inputs: lists of files and times, poses, calibration files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import tiny_layouts as layouts
from bad_files import beside, recorded
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


def depth_for_images(folder: Path) -> None:
    """The list of images names the depth."""
    (folder / "rgb.txt").write_text((folder / "depth.txt").read_text())


def pipe_for(name: str) -> Callable[[Path], None]:
    """A pipe in the place of a file."""

    def change(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return change


def calibrated(content: str | bytes) -> Callable[[Path], Path]:
    """Good images with this `calibration.txt`."""
    return lambda folder: bad.frames(folder / "frames", calibration=content)


HUGE_POSE = {
    "file_path": "images/frame_8.png",
    "transform_matrix": [[1, 0, 0, 10**400], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
}
LISTS = rows(
    "Lists and poses",
    [
        ("tabs", listed(lambda text: text.replace(" rgb/", "\trgb/"))),
        ("commas", listed(lambda text: text.replace(" rgb/", ", rgb/"))),
        ("a pipe that nobody writes into", bad.rgbd(pipe_in_list)),
        ("/dev/zero", listed(lambda text: "9.0 /dev/zero\n" + text)),
        ("a name with a NUL", listed(lambda text: "9.0 a\0b.png\n" + text)),
        ("names with backslashes", listed(lambda text: text.replace("rgb/", "rgb\\"))),
        ("a time of 1e300", listed(lambda text: text + "1e300 rgb/10.000000.png\n")),
        ("times in nanoseconds", listed(lambda text: "1403636579763555584 rgb/10.000000.png\n")),
        ("the depth's list in the place of the images'", bad.rgbd(depth_for_images)),
        ("truth of 1e300 metres", listed(lambda text: "1 1e300 0 0 0 0 0 1\n", "groundtruth.txt"), OPENED),
        ("`rgb.txt` of 20 GB", bad.rgbd(lambda folder: bad.lengthened(folder / "rgb.txt"))),
        ("truth of 20 GB", bad.rgbd(lambda folder: bad.lengthened(folder / "groundtruth.txt")), OPENED),
        ("truth that is a pipe", bad.rgbd(pipe_for("groundtruth.txt")), OPENED),
        ("poses of ARKitScenes out of order", recorded(layouts.arkit, backwards("lowres_wide.traj")), OPENED),
        ("poses of Stray Scanner out of order", recorded(layouts.stray, backwards("odometry.csv", 1)), OPENED),
        ("Stray Scanner without its poses", recorded(layouts.stray, lambda made: (made / "odometry.csv").unlink())),
        ("poses of Replica that are cut before the images", recorded(layouts.replica, later_images), OPENED),
        (
            "an alignment of Tanks and Temples that shears",
            recorded(layouts.tanks, bad.write("scan_trans.txt", "1 5 0 0 0 1 0 0 0 0 1 0 0 0 0 1")),
            OPENED,
        ),
        (
            "a pose of 400 digits in `transforms.json`",
            recorded(layouts.nerfstudio, other_numbers("transforms.json", frames=[HUGE_POSE])),
        ),
    ],
    call=read_frames,
)
CALIBRATION = rows(
    "Calibration",
    [
        ("focal lengths of 55 and 5500", calibrated("55 5500 31.5 23.5")),
        ("cx and cy in each other's place", calibrated("55 55 23.5 31.5")),
        ("a principal point left of the image", calibrated("55 55 -300 23.5")),
        ("an infinite focal length", calibrated("inf 55 31.5 23.5")),
        ("a focal length of 1e300", calibrated("1e300 1e300 31.5 23.5")),
        ("distortion with a NaN", calibrated("55 55 31.5 23.5 nan 0 0 0")),
        ("distortion of 1e300", calibrated("55 55 31.5 23.5 1e300 0 0 0")),
        ("semicolons", calibrated("55; 55; 31.5; 23.5")),
        ("names before the numbers", calibrated("fx: 55\nfy: 55\ncx: 31.5\ncy: 23.5")),
        ("five million numbers", calibrated("5 " * 5_000_000)),
        ("a pipe", beside(pipe_for("calibration.txt"))),
        ("Replica's, of other images", recorded(layouts.replica, other_numbers("cam_params.json", w=1200, h=680))),
        (
            "Replica's, a scale of 400 digits",
            recorded(layouts.replica, other_numbers("cam_params.json", scale=10**400)),
        ),
        (
            "Record3D's, numbers of 400 digits",
            recorded(layouts.record3d, other_numbers("metadata", perFrameIntrinsicCoeffs=[[10**400] * 4] * 3)),
        ),
        ("Record3D's, whose size is in texts", recorded(layouts.record3d, other_numbers("metadata", w="40", h="30.0"))),
    ],
    call=read_frames,
)
ALL_LISTS: list[Row] = [*LISTS, *CALIBRATION]
