"""ScanNet as its two SensReader programs export it.

| SensReader in Python | in C++ (BundleFusion's scans, too) | |
|---|---|---|
| `color/0.jpg` | `frame-000000.color.jpg` | |
| `depth/0.png` | `frame-000000.depth.pgm` or `.png` | millimetres |
| `pose/0.txt` | `frame-000000.pose.txt` | camera -> world |
| `intrinsic/intrinsic_color.txt`, `..._depth.txt` | `_info.txt` or `info.txt` | of both cameras |
| `intrinsic/extrinsic_color.txt`, `..._depth.txt` | the same | optional, rig -> camera |

The colour images are larger than the depth images and of another camera. They are resampled to the intrinsics of the
depth camera, so that depth need not be interpolated. If the extrinsics of the cameras differ, depth and poses are
transformed to the colour camera.

Source: A. Dai et al., "ScanNet", CVPR 2017.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from vggtgeo.datasets.depth_registration import DepthRegistration
from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.image_files import MILLIMETRES, ImageFile, read_depth
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like, image_files
from vggtgeo.datasets.intrinsics import check_plausible, intrinsics_of, warn_if_other_size
from vggtgeo.datasets.pose_files import have_rotations, numbers_of, parsing, read_matrix, trajectory_of
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import whole_text

_COLOUR = frozenset({".jpg", ".jpeg", ".png"})


@dataclass(frozen=True)
class ScanNet(FolderSequence):
    """One scan. Ground truth: the pose files, camera -> world, without those of lost frames (infinities)."""

    colour: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    """Intrinsics of the colour images as stored."""
    motion: np.ndarray = field(default_factory=lambda: np.eye(4), compare=False, repr=False)
    """float64 [4, 4], depth camera -> colour camera, metres."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        if all((folder / name).is_dir() for name in ("color", "depth", "pose", "intrinsic")):
            return True
        return _info(folder) is not None and bool(files_like(folder, "frame-*.color.*"))

    @classmethod
    def open(cls, folder: Path) -> Self:
        place = folder / "color"
        images = image_files(place, _COLOUR) if place.is_dir() else files_like(folder, "frame-*.color.*")
        frames = [
            (_number(image, index) / FRAMES_PER_SECOND, image, _depth(folder, image))
            for index, image in enumerate(images)
        ]
        colour, depth = _intrinsics(folder, "color"), _intrinsics(folder, "depth")

        def camera(width: int, height: int) -> Camera:
            # Checked since an absurd ratio of the focal lengths would make the blur below arbitrarily wide.
            stored = Camera(colour, width, height)
            check_plausible(f"`{folder}`: the colour camera", stored)
            warn_if_other_size(f"`{folder}`: the colour camera", stored)
            return Camera(depth, *_size(folder, [depth for _, _, depth in frames]))

        motion = _extrinsics(folder, "color") @ np.linalg.inv(_extrinsics(folder, "depth"))
        return cls.listed(folder, frames, camera, colour=colour, motion=motion)

    def load_image(self, path: Path, min_bits: int = 8) -> ImageFile:
        """Return the image, blurred and resampled to the intrinsics of the depth camera."""
        read = self.stored_image(path, min_bits)
        image = read.image
        fx, fy, cx, cy = self.camera.intrinsics
        gx, gy, dx, dy = self.colour
        blur = max(gx / fx, 1.0), max(gy / fy, 1.0)
        if max(blur) > 1.0:  # against aliasing of thin structures
            image = cv2.GaussianBlur(image, (0, 0), 0.5 * blur[0], sigmaY=0.5 * blur[1])
        change = np.array([[gx / fx, 0.0, dx - cx * gx / fx], [0.0, gy / fy, dy - cy * gy / fy]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = (self.camera.width, self.camera.height)
        seen = cv2.warpAffine(image, change, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return replace(read, image=np.asarray(seen, np.uint8))

    def load_depth(self, path: Path) -> np.ndarray:
        """Return the depth at the colour camera, with the intrinsics of the depth camera."""
        depth = super().load_depth(path)
        wrong = depth.shape != (self.camera.height, self.camera.width)  # the base class reports it
        return depth if wrong or self._registration is None else self._registration(depth)

    @cached_property
    def _registration(self) -> DepthRegistration | None:
        """Return the registration of the depth to the colour camera; None if both cameras have the same pose."""
        same_pose = np.array_equal(self.motion, np.eye(4))
        return None if same_pose else DepthRegistration.of(self.camera, self.camera, self.motion)

    def ground_truth(self) -> Trajectory | None:
        files = [(one.timestamp, _beside(self.folder, one.image, "pose", ".txt")) for one in self.files]
        files = [(time, file) for time, file in files if file.is_file()]
        if not files:
            return None
        poses = np.array([read_matrix(file, (4, 4)) for _, file in files])
        if self._registration is not None:
            with np.errstate(invalid="ignore"):  # of lost frames, which have infinities
                poses = poses @ np.linalg.inv(self.motion)
        return trajectory_of([time for time, _ in files], poses, self.folder / "pose")


def _number(image: Path, index: int) -> int:
    found = re.fullmatch(r"(?:frame-)?([0-9]{1,9})(?:[.]color)?", image.stem)
    return int(found.group(1)) if found else index


def _beside(folder: Path, image: Path, what: str, suffix: str) -> Path:
    """Return the file of an image's depth or pose, in either layout."""
    if image.parent == folder:
        return folder / (image.stem.removesuffix(".color") + f".{what}{suffix}")
    return folder / what / f"{image.stem}{suffix}"


def _depth(folder: Path, image: Path) -> Path | None:
    return next((path for end in (".png", ".pgm") if (path := _beside(folder, image, "depth", end)).is_file()), None)


def _info(folder: Path) -> Path | None:
    """Return the calibration file that the C++ SensReader writes; None for another program's `info.txt`."""
    files = (folder / name for name in ("_info.txt", "info.txt"))
    return next((file for file in files if file.is_file() and "m_calibration" in whole_text(file)), None)


def _intrinsics(folder: Path, camera: str) -> tuple[float, float, float, float]:
    """Return the intrinsics of `color` or `depth`."""
    file, matrix = _calibration(folder, "intrinsic", camera)
    return intrinsics_of(file, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))


def _extrinsics(folder: Path, camera: str) -> np.ndarray:
    """Return the transformation rig -> camera; the identity by default."""
    file, matrix = _calibration(folder, "extrinsic", camera, np.eye(4))
    if not have_rotations(matrix[None])[0] or not np.isfinite(matrix).all():
        raise InputError(f"`{file}`: the {camera} extrinsics must be a rigid motion, got {matrix.tolist()}")
    return matrix


def _calibration(folder: Path, what: str, camera: str, unstated: np.ndarray | None = None) -> tuple[Path, np.ndarray]:
    """Return a matrix [4, 4] of either layout, and its file. unstated: default value if it is missing."""
    file, info = folder / "intrinsic" / f"{what}_{camera}.txt", _info(folder)
    if file.is_file() or info is None:
        return file, unstated if unstated is not None and not file.is_file() else read_matrix(file, (4, 4))
    key = f"m_calibration{camera.capitalize()}{what.capitalize()}"
    found = re.search(rf"^{key}\s*=(.*)$", whole_text(info), re.MULTILINE)
    if found is None and unstated is not None:
        return info, unstated
    with parsing(info, f"`{key}` of 16 numbers"):
        return info, np.reshape(numbers_of(found.group(1).split() if found else [], f"`{key}`"), (4, 4))


def _size(folder: Path, depths: Sequence[Path | None]) -> tuple[int, int]:
    """Return width and height of the first depth image that can be read."""
    for file in filter(None, depths):
        with suppress(InputError):
            height, width = read_depth(file, MILLIMETRES).shape
            return width, height
    raise InputError(f"`{folder}` has no depth image that can be read; the camera's size is unknown")
