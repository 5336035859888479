"""KITTI, left camera: odometry (`image_0` or `image_2`, `times.txt`), raw (`image_02/data`, `timestamps.txt`).

Source: A. Geiger et al., "Are we ready for autonomous driving?", CVPR 2012.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Self

import numpy as np

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.images import image_files, rows_of
from vggtgeo.datasets.intrinsics import camera_or_guess, intrinsics_of
from vggtgeo.datasets.pose_files import check_size, parsing, poses_of_rows, trajectory_of_rows
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory, read_matrices
from vggtgeo.io.errors import InputError, NoteWarning, warn
from vggtgeo.io.files import whole_text

RATE = 10.0
_FOLDERS = ("image_2", "image_0", "image_02/data", "image_00/data")
_LINES = {"image_2": ("P2",), "image_0": ("P0",), "image_02": ("P_rect_02", "P2"), "image_00": ("P_rect_00", "P0")}


@dataclass(frozen=True)
class Kitti(FolderSequence):
    """One drive. Ground truth: `poses.txt` in the folder, or `poses/NN.txt` beside the sequences; poses of the left
    grey camera, transformed to the colour camera if that is read.
    """

    baseline: float = 0.0
    """Metres along x from the left grey camera, to which the ground truth refers, to this camera."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return any((folder / name).is_dir() for name in _FOLDERS)

    @classmethod
    def open(cls, folder: Path) -> Self:
        images = {folder / name: image_files(folder / name) for name in _FOLDERS}
        image_folder = max(images, key=lambda each: len(images[each]))  # the first, colour, if numbers are equal
        times = _times(folder, image_folder)
        rows = rows_of(images[image_folder], len(times) if times else None)
        if times and max(rows, default=-1) >= len(times):
            raise InputError(
                f"`{folder}` must have a time for each image of the drive, got {len(times)} times for {len(rows)} "
                f"images with numbers up to {max(rows)}, counted from 0"
            )
        image_times = [times[row] if times else (row - rows[0]) / RATE for row in rows]
        frames = [(time, image, None) for time, image in zip(image_times, images[image_folder], strict=True)]
        if (folder / "oxts").is_dir():
            warn(f"`{folder}`: GPS and IMU in `oxts` are not read, so there is no ground truth", NoteWarning)
        name = image_folder.relative_to(folder).parts[0]
        baseline = 0.0

        def camera(width: int, height: int) -> Camera:
            nonlocal baseline
            found, baseline = _camera(folder, name, width, height)
            return found

        whole = cls.listed(folder, frames, camera)
        return replace(whole, baseline=baseline)

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses of the camera that is read."""
        name = f"{self.folder.resolve().name}.txt"
        places = (self.folder / "poses.txt", self.folder.resolve().parent.parent / "poses" / name)
        file = next((file for file in places if file.is_file()), None)
        if file is None:
            return None
        poses = poses_of_rows(read_matrices(file, 12))
        poses[:, :3, 3] += self.baseline * poses[:, :3, 0]
        lines = rows_of([one.image for one in self.files], len(poses))  # may have fewer lines than the list of times
        return trajectory_of_rows([one.timestamp for one in self.files], lines, poses, file)


def _times(folder: Path, image_folder: Path) -> list[float]:
    """Return the times of all lines, seconds; empty without a list."""
    seconds, stamps = folder / "times.txt", image_folder.parent / "timestamps.txt"
    file = seconds if seconds.is_file() else stamps
    if not file.is_file():
        return []
    with parsing(file, "the time of each image, `0.1` or `2011-09-26 13:02:25.594360389`"):
        if file == seconds:
            times = read_matrices(file, 1)[:, 0].tolist()
        else:
            moments = [datetime.fromisoformat(line[:26]) for line in whole_text(file).splitlines() if line.strip()]
            times = [(moment - moments[0]).total_seconds() for moment in moments]
        if not times:
            raise ValueError("the file is empty")
    return times


def _camera(folder: Path, name: str, width: int, height: int) -> tuple[Camera, float]:
    """Return the camera, and its baseline from the left grey one: the fourth number of `P` is `-fx b`."""
    size = name.replace("image", "S_rect")
    for file in (
        folder / "calib.txt",
        folder / "calib_cam_to_cam.txt",
        folder.resolve().parent / "calib_cam_to_cam.txt",
    ):
        values = _calibration(file)
        for key in _LINES[name]:
            if key in values:
                if size in values:  # the images of an unrectified drive are larger
                    check_size(file, _numbers(file, values, size, 2).tolist(), (width, height))
                row = _numbers(file, values, key, 12)
                intrinsics = intrinsics_of(file, row[[0, 5, 2, 6]].tolist())
                return Camera(intrinsics, width, height), float(-row[3] / row[0])
    return camera_or_guess(folder, width, height), 0.0


def _calibration(file: Path) -> dict[str, str]:
    """Return lines `KEY: VALUES` by key."""
    lines = whole_text(file).splitlines() if file.is_file() else []
    parts = [line.partition(":") for line in lines]
    return {key.strip(): rest for key, _, rest in parts}


def _numbers(file: Path, values: Mapping[str, str], key: str, count: int) -> np.ndarray:
    with parsing(file, f"`{key}` of {count} numbers"):
        return np.array(values[key].split(), np.float64).reshape(count)
