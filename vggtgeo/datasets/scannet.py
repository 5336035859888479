"""ScanNet as its reader exports it: `color/N.jpg`, `depth/N.png`, `pose/N.txt`, `intrinsic/intrinsic_*.txt`.

The colour images are larger than the depth and of another camera; each is brought to the depth camera, whose pixels are
fewer, so that no depth is made up. The two cameras are taken to be at one place, as the published extrinsics say.
Source: A. Dai et al., "ScanNet", CVPR 2017.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from vggtgeo.datasets.folder import FolderSequence, FrameFile, common_size
from vggtgeo.datasets.image_files import MILLIMETRES, ImageFile, read_depth, read_image_file
from vggtgeo.datasets.images import FRAMES_PER_SECOND, natural_key
from vggtgeo.datasets.intrinsics import check_plausible, intrinsics_of
from vggtgeo.datasets.pose_files import read_matrix, trajectory_of
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError


@dataclass(frozen=True)
class ScanNet(FolderSequence):
    """One scan. Truth: the pose files, camera -> world; those of lost frames hold infinities and are left out."""

    colour: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    """Intrinsics of the colour images as they lie on the disk."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Whether `folder` has `color`, `depth`, `pose` and `intrinsic`."""
        return all((folder / name).is_dir() for name in ("color", "depth", "pose", "intrinsic"))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Lists the frames that have an image."""
        images = sorted((folder / "color").iterdir(), key=lambda path: natural_key(path.name))
        images = [image for image in images if image.suffix.lower() in (".jpg", ".jpeg", ".png")]
        if not images:
            raise InputError(f"`{folder}/color` has no images; expected a scan of ScanNet, exported")
        files = tuple(
            FrameFile(index, _number(image, index) / FRAMES_PER_SECOND, image, _depth(folder, image))
            for index, image in enumerate(images)
        )
        colour, depth = (_intrinsics(folder / "intrinsic" / f"intrinsic_{name}.txt") for name in ("color", "depth"))
        width, height = _size(folder, files)
        # An absurd ratio of the two cameras would make a filter of any width.
        check_plausible(f"`{folder}/intrinsic/intrinsic_color.txt`", Camera(colour, *common_size(str(folder), files)))
        has_depth = any(file.depth is not None for file in files)
        camera = Camera(depth, width, height)
        return cls(folder, folder.resolve().name, camera, files, MILLIMETRES, has_depth, colour)

    def load_image(self, path: Path, least_bits: int = 8) -> ImageFile:
        """The image as the depth camera would see it: an affine change of pixels, reduced with an average."""
        read = read_image_file(path, least_bits)
        image = read.image
        fx, fy, cx, cy = self.camera.intrinsics
        gx, gy, dx, dy = self.colour
        blur = max(gx / fx, 1.0), max(gy / fy, 1.0)
        if max(blur) > 1.0:  # without it, thin structures would come and go from frame to frame
            image = cv2.GaussianBlur(image, (0, 0), 0.5 * blur[0], sigmaY=0.5 * blur[1])
        change = np.array([[gx / fx, 0.0, dx - cx * gx / fx], [0.0, gy / fy, dy - cy * gy / fy]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = (self.camera.width, self.camera.height)
        seen = cv2.warpAffine(image, change, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return replace(read, image=np.asarray(seen, np.uint8))

    def ground_truth(self) -> Trajectory | None:
        """The true poses."""
        there = [(one.timestamp, self.folder / "pose" / f"{one.image.stem}.txt") for one in self.files]
        there = [(time, file) for time, file in there if file.is_file()]
        if not there:
            return None
        poses = np.array([read_matrix(file, (4, 4)) for _, file in there])
        return trajectory_of([time for time, _ in there], poses, self.folder / "pose")


def _number(image: Path, index: int) -> int:
    return int(image.stem) if image.stem.isdecimal() else index


def _depth(folder: Path, image: Path) -> Path | None:
    path = folder / "depth" / f"{image.stem}.png"
    return path if path.is_file() else None


def _intrinsics(file: Path) -> tuple[float, float, float, float]:
    matrix = read_matrix(file, (4, 4))
    return intrinsics_of(file, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))


def _size(folder: Path, files: tuple[FrameFile, ...]) -> tuple[int, int]:
    """Width and height of the depth images: of the first that can be read."""
    wrong = "has no depth image"
    for file in files:
        if file.depth is not None:
            try:
                height, width = read_depth(file.depth, MILLIMETRES).shape
            except InputError as error:
                wrong = f"has no depth image that can be read ({error})"
                continue
            return width, height
    raise InputError(f"`{folder}/depth` {wrong}; the size of the depth camera is not known")
