"""ICL-NUIM in its TUM-compatible form: `rgb/N.png`, `depth/N.png`, `*.gt.freiburg`, mostly with `associations.txt`.

Its camera has a negative fy: the image's y axis points up. Images are read unchanged with a positive fy, which mirrors
the world; so the ground truth is mirrored as well, and errors are the same. Source: A. Handa et al., "A benchmark
for RGB-D visual odometry, 3D reconstruction and SLAM", ICRA 2014.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.image_files import FIVE_THOUSANDTHS
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like
from vggtgeo.datasets.intrinsics import guess_with_warning
from vggtgeo.datasets.pose_files import poses_of, read_matrices, trajectory_of
from vggtgeo.datasets.tum import MOST_LETTERS, read_pairs
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

_CAMERA, _SIZE = (481.20, 480.00, 319.50, 239.50), (640, 480)
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_LIST = "associations.txt"


@dataclass(frozen=True)
class IclNuim(FolderSequence):
    """One sequence. Times are numbers of frames / 30 s. Truth: `*.gt.freiburg` or `groundtruth.txt`, mirrored in y."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has ICL-NUIM's `associations.txt` and no `rgb.txt`: with its ground truth, or a list
        of frame numbers, depth first; or pairs of numbered images with its ground truth. A list of times may be of any
        program.
        """
        file, truth = folder / _LIST, bool(files_like(folder, "*.gt.freiburg"))
        if (folder / "rgb.txt").is_file():
            return False
        if not file.is_file():
            return truth and bool(_numbered(folder))
        with file.open(encoding="utf-8-sig", errors="replace") as lines:
            head = (line[:MOST_LETTERS].split("#", 1)[0].split() for line in itertools.islice(lines, 5))
            words = next(filter(None, head), [])
        counted = len(words) == 4 and words[0].isdecimal() and "depth" in words[1]
        return counted or truth

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Read the list of pairs, or pair the images by their numbers without one."""
        pairs = read_pairs(folder / _LIST, "N") if (folder / _LIST).is_file() else _numbered(folder)
        if not pairs:
            raise InputError(f"`{folder}` has neither `{_LIST}` nor images `rgb/N.png` with `depth/N.png`")
        frames = [
            (number / FRAMES_PER_SECOND, folder / image, folder / depth) for number, image, depth in sorted(pairs)
        ]
        return cls.listed(folder, frames, lambda *size: icl_camera(folder, *size), FIVE_THOUSANDTHS)

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses of the mirrored world."""
        return icl_truth(self.folder)


def icl_camera(folder: Path, width: int, height: int) -> Camera:
    """Return the published camera, fy positive; a guess, with a warning, for images of another size."""
    if (width, height) != _SIZE:
        return guess_with_warning(str(folder), width, height)
    return Camera(_CAMERA, width, height)


def icl_truth(folder: Path) -> Trajectory | None:
    """Return the poses of `*.gt.freiburg` or `groundtruth.txt` in the mirrored world; None without either."""
    there = [*files_like(folder, "*.gt.freiburg"), folder / "groundtruth.txt"]
    file = next((file for file in there if file.is_file()), None)
    if file is None:
        return None
    rows = read_matrices(file, 8)
    poses = poses_of(rows[:, 1:4], rows[:, 4:])
    return trajectory_of(rows[:, 0] / FRAMES_PER_SECOND, MIRROR @ poses @ MIRROR, file)


def _numbered(folder: Path) -> list[tuple[float, str, str]]:
    """Return number, image and depth of each pair `rgb/N.png`, `depth/N.png`, as `read_pairs` does."""
    images = [path for path in files_like(folder / "rgb", "*.png") if path.stem.isdecimal()]
    both = [path for path in images if (folder / "depth" / path.name).is_file()]
    return [(float(path.stem), f"rgb/{path.name}", f"depth/{path.name}") for path in both]
