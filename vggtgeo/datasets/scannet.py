"""ScanNet as its readers export it.

| SensReader in Python | in C++ (BundleFusion's scans, too) | |
|---|---|---|
| `color/0.jpg` | `frame-000000.color.jpg` | |
| `depth/0.png` | `frame-000000.depth.pgm` or `.png` | millimetres |
| `pose/0.txt` | `frame-000000.pose.txt` | camera -> world |
| `intrinsic/intrinsic_color.txt`, `..._depth.txt` | `_info.txt` or `info.txt` | of both cameras |

The colour images are larger than the depth and of another camera; each is brought to the depth camera, whose pixels are
fewer, so that no depth is made up. The two cameras are taken to be at one place, as the published extrinsics say.
Source: A. Dai et al., "ScanNet", CVPR 2017.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from vggtgeo.datasets.folder import FolderSequence, FrameFile, common_size, tell_of_no_depth
from vggtgeo.datasets.image_files import MILLIMETRES, ImageFile, read_depth, read_image_file
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like, image_files
from vggtgeo.datasets.intrinsics import check_plausible, intrinsics_of, warn_of_other_size
from vggtgeo.datasets.pose_files import numbers_of, read_matrix, read_text, trajectory_of
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

_COLOUR = frozenset({".jpg", ".jpeg", ".png"})


@dataclass(frozen=True)
class ScanNet(FolderSequence):
    """One scan. Truth: the pose files, camera -> world; those of lost frames hold infinities and are left out."""

    colour: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    """Intrinsics of the colour images as they lie on the disk."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Whether `folder` has `color`, `depth`, `pose` and `intrinsic`, or images beside `_info.txt`."""
        if all((folder / name).is_dir() for name in ("color", "depth", "pose", "intrinsic")):
            return True
        return _info(folder) is not None and bool(files_like(folder, "frame-*.color.*"))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Lists the frames that have an image."""
        place = folder / "color"
        images = image_files(place, _COLOUR) if place.is_dir() else files_like(folder, "frame-*.color.*")
        if not images:
            raise InputError(f"`{place}` has no images; expected a scan of ScanNet, exported")
        files = tuple(
            FrameFile(index, _number(image, index) / FRAMES_PER_SECOND, image, _depth(folder, image))
            for index, image in enumerate(images)
        )
        tell_of_no_depth(folder, files)
        colour, depth = _intrinsics(folder, "color"), _intrinsics(folder, "depth")
        width, height = _size(folder, files)
        # An absurd ratio of the two cameras would make a filter of any width.
        taken = Camera(colour, *common_size(str(folder), files))
        check_plausible(f"`{folder}`: the colour camera", taken)
        warn_of_other_size(f"`{folder}`: the colour camera", taken)
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
        there = [(one.timestamp, _beside(self.folder, one.image, "pose", ".txt")) for one in self.files]
        there = [(time, file) for time, file in there if file.is_file()]
        if not there:
            return None
        poses = np.array([read_matrix(file, (4, 4)) for _, file in there])
        return trajectory_of([time for time, _ in there], poses, self.folder / "pose")


def _number(image: Path, index: int) -> int:
    found = re.fullmatch(r"(?:frame-)?([0-9]{1,9})(?:[.]color)?", image.stem)
    return int(found.group(1)) if found else index


def _beside(folder: Path, image: Path, what: str, suffix: str) -> Path:
    """The file of an image's depth or pose, in either layout."""
    if image.parent == folder:
        return folder / (image.stem.removesuffix(".color") + f".{what}{suffix}")
    return folder / what / f"{image.stem}{suffix}"


def _depth(folder: Path, image: Path) -> Path | None:
    return next((path for end in (".png", ".pgm") if (path := _beside(folder, image, "depth", end)).is_file()), None)


def _info(folder: Path) -> Path | None:
    """The file of both cameras that SensReader in C++ writes; another program's `info.txt` is none."""
    own, other = folder / "_info.txt", folder / "info.txt"
    if own.is_file():
        return own
    return other if other.is_file() and "m_calibration" in read_text(other) else None


def _intrinsics(folder: Path, camera: str) -> tuple[float, float, float, float]:
    """Of `color` or `depth`."""
    file = folder / "intrinsic" / f"intrinsic_{camera}.txt"
    if (info := _info(folder)) is not None and not file.is_file():
        file, key = info, f"m_calibration{camera.capitalize()}Intrinsic"
        found = re.search(rf"^{key}\s*=(.*)$", read_text(file), re.MULTILINE)
        values = numbers_of(found.group(1).split() if found else [], f"`{file}`: `{key}`")
        if len(values) != 16:
            raise InputError(f"`{file}`: `{key}` has {len(values)} numbers; expected 16")
        matrix = np.array(values).reshape(4, 4)
    else:
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
