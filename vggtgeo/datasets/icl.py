"""ICL-NUIM in its TUM-compatible form: `rgb/N.png`, `depth/N.png`, `*.gt.freiburg`, mostly with `associations.txt`; and
as POV-Ray rendered it: `scene_00_0000.png` with the camera in `scene_00_0000.txt` and depth in `scene_00_0000.depth`.

Its camera has a negative fy: the image's y axis points up. Images are read unchanged with a positive fy, which mirrors
the world; so the ground truth is mirrored as well, and errors are the same.

The rendered depth is a text of 640 x 480 distances from the camera's centre along the ray of each pixel, metres, row by
row. With the ray `r = ((u - cx) / fx, (v - cy) / fy, 1)` of the pixel (u, v) the depth is `z = d / |r|`. The camera's
file states its position, its viewing direction `dir` and its upward direction `up`; the axes of camera -> world, with y
up, are `z = dir`, `x = up x z`, `y = z x x`.

Source: A. Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM", ICRA 2014.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float

from vggtgeo.datasets.folder import FolderSequence, existing
from vggtgeo.datasets.image_files import FIVE_THOUSANDTHS, metres_of_floats
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like, rows_of
from vggtgeo.datasets.intrinsics import guess_with_warning
from vggtgeo.datasets.pose_files import numbers_of, parsing, trajectory_of
from vggtgeo.datasets.tum import head_of, read_pairs
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory, poses_of, read_matrices
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import whole_text

_CAMERA, _SIZE = (481.20, 480.00, 319.50, 239.50), (640, 480)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_IMAGE = re.compile(r"scene_\d+_\d+")
_VECTOR = r"^\s*{}\s*=\s*\[([^\]]*)\]"
_LIST = "associations.txt"


@dataclass(frozen=True)
class IclNuim(FolderSequence):
    """One sequence. Times are numbers of frames / 30 s. Truth: `*.gt.freiburg` or `groundtruth.txt`, mirrored in y."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has no `rgb.txt`, and ground truth with a list of pairs or numbered images, or a list
        of frame numbers with the depth first. A list of times is not enough: other programs write such lists.
        """
        file, truth = folder / _LIST, bool(files_like(folder, "*.gt.freiburg"))
        if (folder / "rgb.txt").is_file():
            return False
        if not file.is_file():
            return truth and bool(_numbered(folder))
        words = next(filter(None, (line.split() for line in head_of(file))), [])
        return truth or (len(words) == 4 and words[0].isdecimal() and "depth" in words[1])

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Read the list of pairs, or pair the images by their numbers without one."""
        pairs = read_pairs(folder / _LIST, "N") if (folder / _LIST).is_file() else _numbered(folder)
        frames = [
            (number / FRAMES_PER_SECOND, folder / image, folder / depth) for number, image, depth in sorted(pairs)
        ]
        return cls.listed(folder, frames, lambda *size: _camera(folder, *size), FIVE_THOUSANDTHS)

    def ground_truth(self) -> Trajectory | None:
        return _truth(self.folder)


def _camera(folder: Path, width: int, height: int) -> Camera:
    """Return the published camera, fy positive; a guess, with a warning, for images of another size."""
    if (width, height) != _SIZE:
        return guess_with_warning(str(folder), width, height)
    return Camera(_CAMERA, width, height)


def _truth(folder: Path) -> Trajectory | None:
    """Return the poses of `*.gt.freiburg` or `groundtruth.txt` in the mirrored world; None without either."""
    candidates = [*files_like(folder, "*.gt.freiburg"), folder / "groundtruth.txt"]
    file = next((file for file in candidates if file.is_file()), None)
    if file is None:
        return None
    rows = read_matrices(file, 8)
    poses = poses_of(rows[:, 1:4], rows[:, 4:])
    return trajectory_of(rows[:, 0] / FRAMES_PER_SECOND, _MIRROR @ poses @ _MIRROR, file)


def _numbered(folder: Path) -> list[tuple[float, str, str]]:
    """Return number, image and depth of each pair `rgb/N.png`, `depth/N.png`, as `read_pairs` does."""
    names = [path.name for path in files_like(folder / "rgb", "*.png") if path.stem.isdecimal()]
    both = [name for name in names if (folder / "depth" / name).is_file()]
    return [(float(Path(name).stem), f"rgb/{name}", f"depth/{name}") for name in both]


@dataclass(frozen=True)
class IclNuimRaw(FolderSequence):
    """One rendered sequence. Truth: the camera file of each image, else `*.gt.freiburg`, mirrored in y."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return any(path.with_suffix(end).is_file() for path in _images(folder) for end in (".depth", ".txt"))

    @classmethod
    def open(cls, folder: Path) -> Self:
        images = _images(folder)
        # The number of the scene comes first in the names: `scene_00_0012`.
        numbers = rows_of([path.with_name(path.stem.rpartition("_")[2]) for path in images], None)
        frames = [
            (number / FRAMES_PER_SECOND, image, existing(image.with_suffix(".depth")))
            for number, image in zip(numbers, images, strict=True)
        ]
        return cls.listed(folder, frames, lambda *size: _camera(folder, *size))

    def load_depth(self, path: Path) -> Float[np.ndarray, "h w"]:
        """Return the depth along the optical axis, float32, NaN for none; raise InputError for a wrong count."""
        width, height = self.camera.width, self.camera.height
        with parsing(path, f"{width} x {height} distances, metres"):
            distances = np.array(whole_text(path).split(), np.float32).reshape(height, width)
        fx, fy, cx, cy = self.camera.intrinsics
        across, down = (np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy
        return metres_of_floats(distances / np.sqrt(1.0 + across**2 + down[:, None] ** 2))

    def ground_truth(self) -> Trajectory | None:
        posed = [file for file in self.files if file.image.with_suffix(".txt").is_file()]
        if not posed:
            return _truth(self.folder)
        poses = np.stack([_pose(file.image.with_suffix(".txt")) for file in posed])
        return trajectory_of([file.timestamp for file in posed], _MIRROR @ poses @ _MIRROR, self.folder)


def _images(folder: Path) -> list[Path]:
    return [path for path in files_like(folder, "scene_*.png") if _IMAGE.fullmatch(path.stem)]


def _pose(file: Path) -> Float[np.ndarray, "4 4"]:
    """Return camera -> world, the camera's y up."""
    text = whole_text(file)
    position, direction, up = (_vector(file, text, name) for name in ("cam_pos", "cam_dir", "cam_up"))
    pose = np.eye(4)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # invalid directions: the pose is left out
        z = direction / np.linalg.norm(direction)
        x = np.cross(up, z)
        x /= np.linalg.norm(x)
        pose[:3] = np.column_stack([x, np.cross(z, x), z, position])
    return pose


def _vector(file: Path, text: str, name: str) -> Float[np.ndarray, "3"]:
    found = re.search(_VECTOR.format(name), text, re.MULTILINE)
    numbers = numbers_of(found.group(1).replace(",", " ").split(), f"`{file}`: `{name}`") if found else []
    if len(numbers) != 3:
        raise InputError(f"`{file}` has no `{name} = [x, y, z]`")
    return np.array(numbers)
