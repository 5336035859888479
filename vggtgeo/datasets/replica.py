"""Replica as rendered for NICE-SLAM: `results/frameXXXXXX.jpg`, `results/depthXXXXXX.png`, `traj.txt`.

The camera and the unit of the depth, 1 / 6553.5 m, are in `cam_params.json` next to the folders of the rooms. Source:
Z. Zhu et al., "NICE-SLAM", CVPR 2022; J. Straub et al., "The Replica Dataset", 2019.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from vggtgeo.datasets.folder import FolderSequence, existing
from vggtgeo.datasets.image_files import DepthFormat
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like, rows_of
from vggtgeo.datasets.intrinsics import camera_from_folder, intrinsics_of
from vggtgeo.datasets.pose_files import check_size, parsing, read_json, trajectory_of_rows
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory, read_matrices
from vggtgeo.io.errors import InputError

_PUBLISHED = (600.0, 600.0, 599.5, 339.5)
_PUBLISHED_SIZE = (1200, 680)
_UNITS = 6553.5
_CAMERA = "cam_params.json"
_EXPECTED = "`camera` with fx, fy, cx, cy and a positive `scale`, units a metre"


@dataclass(frozen=True)
class Replica(FolderSequence):
    """One room. Truth: `traj.txt`, one matrix camera -> world on each line. Without times: 30 frames a second."""

    rows: tuple[int, ...] = ()
    """Line of `traj.txt` of each image."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return (folder / "traj.txt").is_file() and any((folder / "results").glob("frame*"))

    @classmethod
    def open(cls, folder: Path) -> Self:
        images = files_like(folder / "results", "frame*")
        rows = rows_of(images, len(read_matrices(folder / "traj.txt", 16)))
        depths = (image.with_name(image.stem.replace("frame", "depth") + ".png") for image in images)
        frames = [
            ((row - rows[0]) / FRAMES_PER_SECOND, image, existing(depth))
            for row, image, depth in zip(rows, images, depths, strict=True)
        ]
        candidates = folder / _CAMERA, folder.resolve().parent / _CAMERA
        file = next((file for file in candidates if file.is_file()), None)
        with parsing(file or folder, _EXPECTED):
            stated = {"scale": _UNITS} if file is None else read_json(file)["camera"]
            scale = float(stated["scale"])
            if not 0 < scale < math.inf:
                raise ValueError(f"`scale` is {scale}")
        camera = lambda *size: _default_camera(folder, *size) if file is None else _camera(file, stated, *size)
        return cls.listed(folder, frames, camera, DepthFormat(scale), rows=rows)

    def ground_truth(self) -> Trajectory | None:
        file = self.folder / "traj.txt"
        poses = read_matrices(file, 16)
        return trajectory_of_rows([one.timestamp for one in self.files], self.rows, poses, file)


def _camera(file: Path, stated: Mapping[str, Any], width: int, height: int) -> Camera:
    with parsing(file, _EXPECTED):
        check_size(file, (stated.get("w", width), stated.get("h", height)), (width, height))
        return Camera(intrinsics_of(file, [stated[name] for name in ("fx", "fy", "cx", "cy")]), width, height)


def _default_camera(folder: Path, width: int, height: int) -> Camera:
    if (width, height) == _PUBLISHED_SIZE:
        return Camera(_PUBLISHED, width, height)
    own = camera_from_folder(folder, width, height)
    if own is None:
        raise InputError(f"`{folder}` has no `{_CAMERA}`, in it or beside it, and its images are not 1200 x 680 pixels")
    return own
