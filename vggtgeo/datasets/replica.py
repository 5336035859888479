"""Replica as rendered for NICE-SLAM: `results/frameXXXXXX.jpg`, `results/depthXXXXXX.png`, `traj.txt`.

The camera is in `cam_params.json` beside the rooms; the depth is in 1 / 6553.5 m there. Source: Z. Zhu et al.,
"NICE-SLAM", CVPR 2022; J. Straub et al., "The Replica Dataset", 2019.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from vggtgeo.datasets.folder import FolderSequence, FrameFile, common_size, depth_is_usable, warn_of_no_depth
from vggtgeo.datasets.image_files import DepthFormat
from vggtgeo.datasets.images import FRAMES_PER_SECOND, natural_key, rows_of
from vggtgeo.datasets.intrinsics import camera_from_folder, intrinsics_of
from vggtgeo.datasets.pose_files import read_json, read_matrices, same_size, trajectory_of_rows
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

_PUBLISHED = (600.0, 600.0, 599.5, 339.5)
_PUBLISHED_SIZE = (1200, 680)
_UNITS = 6553.5


@dataclass(frozen=True)
class Replica(FolderSequence):
    """One room. Truth: `traj.txt`, a matrix camera -> world a line. The files have no times: 30 frames a second."""

    rows: tuple[int, ...] = ()
    """Of each image the line of `traj.txt`."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Whether `folder` has `traj.txt` and `results/frame...`."""
        return (folder / "traj.txt").is_file() and any((folder / "results").glob("frame*"))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Lists the frames."""
        images = sorted((folder / "results").glob("frame*"), key=lambda path: natural_key(path.name))
        if not images:
            raise InputError(f"`{folder}` has no `results/frameXXXXXX.jpg`; expected a room of Replica")
        rows = rows_of(images, _poses_in(folder / "traj.txt"))
        files = tuple(
            FrameFile(index, (row - rows[0]) / FRAMES_PER_SECOND, image, _depth(image))
            for index, (row, image) in enumerate(zip(rows, images, strict=True))
        )
        warn_of_no_depth(folder, files)
        width, height = common_size(str(folder), files)
        camera, units = _camera(folder, width, height)
        coding = DepthFormat(units)
        has_depth = depth_is_usable(str(folder), files, coding, width, height)
        return cls(folder, folder.resolve().name, camera, files, coding, has_depth, rows=rows)

    def ground_truth(self) -> Trajectory | None:
        """The true poses."""
        file = self.folder / "traj.txt"
        poses = read_matrices(file, 16)
        return trajectory_of_rows([one.timestamp for one in self.files], self.rows, poses, file)


def _poses_in(file: Path) -> int | None:
    """How many poses there are; None where the file cannot be read, which is told where its poses are asked for."""
    try:
        return len(read_matrices(file, 16))
    except InputError:
        return None


def _depth(image: Path) -> Path | None:
    path = image.with_name(image.stem.replace("frame", "depth") + ".png")
    return path if path.is_file() else None


def _camera(folder: Path, width: int, height: int) -> tuple[Camera, float]:
    for file in (folder / "cam_params.json", folder.resolve().parent / "cam_params.json"):
        if file.is_file():
            values = read_json(file)
            try:
                camera = values["camera"]
                found = tuple(float(camera[name]) for name in ("fx", "fy", "cx", "cy"))
                scale = float(camera["scale"])
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(f"`{file}`: expected `camera` with fx, fy, cx, cy and scale ({error!r})") from None
            if not (math.isfinite(scale) and scale > 0):
                raise InputError(f"`{file}`: `scale` is {scale}; it must be a positive number of units a metre")
            stated = camera.get("w", width), camera.get("h", height)
            if not same_size(stated, (width, height)):
                raise InputError(
                    f"`{file}` is of images of {stated[0]} x {stated[1]} pixels; those here are {width} x {height}: "
                    "write the camera of these into it"
                )
            return Camera(intrinsics_of(file, found), width, height), scale
    own = camera_from_folder(folder, width, height)
    if own is None and (width, height) != _PUBLISHED_SIZE:
        raise InputError(
            f"`{folder}` has no `cam_params.json`, and its images are {width} x {height} pixels; those of the "
            f"published camera are {_PUBLISHED_SIZE[0]} x {_PUBLISHED_SIZE[1]}: put that file beside the scene"
        )
    return own or Camera(_PUBLISHED, width, height), _UNITS
