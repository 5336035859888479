"""ICL-NUIM as POV-Ray rendered it: `scene_00_0000.png` with the camera in `scene_00_0000.txt` and depth in
`scene_00_0000.depth` beside.

The depth is a text of 640 x 480 distances from the camera's centre along the ray of each pixel, metres, row by row.
With the ray `r = ((u - cx) / fx, (v - cy) / fy, 1)` of the pixel (u, v) the depth is `z = d / |r|`. The camera's file
names its place, where it looks and what is up in the image: `z = dir`, `x = up x z`, `y = z x x`, camera -> world, with
y up. As in `icl.py` the images stay as they are and the world is mirrored. Source: A. Handa et al., ICRA 2014, and the
programs of their repository that read these files.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float

from vggtgeo.datasets.folder import FolderSequence, existing
from vggtgeo.datasets.icl import MIRROR, icl_camera, icl_truth
from vggtgeo.datasets.image_files import MAX_DEPTH
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like, rows_of
from vggtgeo.datasets.pose_files import numbers_of, read_text, trajectory_of
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

_IMAGE = re.compile(r"scene_\d+_\d+")
_VECTOR = r"^\s*{}\s*=\s*\[([^\]]*)\]"


@dataclass(frozen=True)
class IclNuimRaw(FolderSequence):
    """One sequence. Times are numbers of images / 30 s. Truth: that of each image's camera, else `*.gt.freiburg`,
    mirrored in y.
    """

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has a `scene_00_0000.png` and its depth or camera beside."""
        beside = (path.with_suffix(end) for path in _images(folder) for end in (".depth", ".txt"))
        return any(file.is_file() for file in beside)

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images."""
        images = list(_images(folder))
        if not images:
            raise InputError(f"`{folder}` has no images `scene_00_0000.png`; expected ICL-NUIM as POV-Ray rendered it")
        # The number of the scene comes first in the names: `scene_00_0012`.
        numbers = rows_of([path.with_name(path.stem.rpartition("_")[2]) for path in images], None)
        frames = [
            (number / FRAMES_PER_SECOND, image, existing(image.with_suffix(".depth")))
            for number, image in zip(numbers, images, strict=True)
        ]
        return cls.listed(folder, frames, lambda *size: icl_camera(folder, *size), as_images=False)

    def load_depth(self, path: Path) -> Float[np.ndarray, "h w"]:
        """Return the depth along the optical axis, float32, NaN for none; InputError for another count of numbers."""
        width, height = self.camera.width, self.camera.height
        try:
            distances = np.array(read_text(path).split(), np.float32)
        except ValueError:
            raise InputError(f"`{path}`: expected numbers, one distance a pixel") from None
        if len(distances) != width * height:
            raise InputError(f"`{path}` has {len(distances)} numbers; its image has {width} x {height} pixels")
        fx, fy, cx, cy = self.camera.intrinsics
        across, down = (np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy
        depth = distances.reshape(height, width) / np.sqrt(1.0 + across**2 + down[:, None] ** 2)
        known = np.isfinite(depth) & (depth > 0) & (depth <= MAX_DEPTH)
        return np.where(known, depth, np.nan).astype(np.float32)

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses of the mirrored world."""
        there = [file for file in self.files if file.image.with_suffix(".txt").is_file()]
        if not there:
            return icl_truth(self.folder)
        poses = np.stack([_pose(file.image.with_suffix(".txt")) for file in there])
        return trajectory_of([file.timestamp for file in there], MIRROR @ poses @ MIRROR, self.folder)


def _images(folder: Path) -> Iterable[Path]:
    return (path for path in files_like(folder, "scene_*.png") if _IMAGE.fullmatch(path.stem))


def _pose(file: Path) -> Float[np.ndarray, "4 4"]:
    """Return camera -> world, the camera's y up."""
    text = read_text(file)
    place, ahead, up = (_vector(file, text, name) for name in ("cam_pos", "cam_dir", "cam_up"))
    pose = np.eye(4)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # no direction: a pose that is none, left out
        z = ahead / np.linalg.norm(ahead)
        x = np.cross(up, z)
        x /= np.linalg.norm(x)
        pose[:3] = np.column_stack([x, np.cross(z, x), z, place])
    return pose


def _vector(file: Path, text: str, name: str) -> Float[np.ndarray, "3"]:
    found = re.search(_VECTOR.format(name), text, re.MULTILINE)
    numbers = numbers_of(found.group(1).replace(",", " ").split(), f"`{file}`: `{name}`") if found else []
    if len(numbers) != 3:
        raise InputError(f"`{file}` has no `{name} = [x, y, z]'`")
    return np.array(numbers)
