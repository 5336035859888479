"""7-Scenes folders: `frame-XXXXXX.color.png|jpg`, `.depth.png`, `.pose.txt`, numbered at 30 frames/s.

Source: J. Shotton et al., "Scene coordinate regression forests", CVPR 2013. As published, the folder has no
intrinsics, the depth is not registered to the colour image, and poses are those of the depth camera.
"""

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from vggtgeo.datasets.folder import FolderSequence, FrameFile, common_size, depth_is_usable
from vggtgeo.datasets.image_files import MILLIMETRES
from vggtgeo.datasets.intrinsics import camera_from_folder, guess_with_warning
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning

FRAMES_PER_SECOND = 30.0
COLOUR_TRUTH = "groundtruth-colour.txt"
_COLOUR = re.compile(r"frame-(\d+)\.color\.(?:png|jpe?g)")
_KINECT = (525.0, 525.0, 320.0, 240.0)


@dataclass(frozen=True)
class SevenScenes(FolderSequence):
    """One sequence. Truth: `groundtruth-colour.txt` (TUM format) if present, else the pose files."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Whether `folder` has colour frames of this layout, or sequences `seq-XX` that have."""
        return bool(_colour_files(folder)) or bool(_sequences(folder))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Lists the frames; of a folder of sequences, those of the first, with an InputWarning where it has more."""
        if not _colour_files(folder):
            folder = _first_sequence(folder)
        numbered = _colour_files(folder)
        files = tuple(
            FrameFile(index, number / FRAMES_PER_SECOND, image, _beside(image, "depth.png"))
            for index, (number, image) in enumerate(sorted(numbered.items()))
        )
        width, height = common_size(str(folder), files)
        camera = camera_from_folder(folder, width, height) or _published_camera(folder, width, height)
        has_depth = depth_is_usable(str(folder), files, MILLIMETRES, width, height)
        return cls(folder, folder.name, camera, files, MILLIMETRES, has_depth)

    def ground_truth(self) -> Trajectory | None:
        """The true poses; pose files with NaN or infinity (tracking was lost) are left out with an InputWarning."""
        if (self.folder / COLOUR_TRUTH).exists():
            return Trajectory.load_tum(self.folder / COLOUR_TRUTH)
        times, poses = [], []
        for file in self.files:
            pose_file = file.image.with_name(file.image.name.split(".")[0] + ".pose.txt")
            if pose_file.is_file() and (pose := _read_pose(pose_file)) is not None:
                times.append(file.timestamp)
                poses.append(pose)
        return Trajectory(np.array(times), np.array(poses)) if poses else None


def _colour_files(folder: Path) -> dict[int, Path]:
    found = ((match, path) for path in sorted(folder.iterdir()) if (match := _COLOUR.fullmatch(path.name)))
    return {int(match.group(1)): path for match, path in found}


def _sequences(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("seq-*")) if path.is_dir() and _colour_files(path)]


def _first_sequence(folder: Path) -> Path:
    sequences = _sequences(folder)
    if not sequences:
        raise InputError(f"`{folder}` has no `frame-XXXXXX.color.png|jpg`; expected a sequence of 7-Scenes")
    if len(sequences) > 1:
        warnings.warn(
            f"`{folder}` holds {len(sequences)} sequences; reading `{sequences[0].name}`: give the folder of "
            "another to read that",
            InputWarning,
            stacklevel=3,
        )
    return sequences[0]


def _beside(image: Path, suffix: str) -> Path | None:
    path = image.with_name(f"{image.name.split('.')[0]}.{suffix}")
    return path if path.is_file() else None


def _published_camera(folder: Path, width: int, height: int) -> Camera:
    if (width, height) != (640, 480):
        return guess_with_warning(str(folder), width, height)
    warnings.warn(
        f"`{folder}` has no intrinsics; taking those of the Kinect's colour camera, {_KINECT}. "
        "In 7-Scenes as published, depth and poses belong to the depth camera (f = 585): register the depth",
        InputWarning,
        stacklevel=3,
    )
    return Camera(_KINECT, width, height)


def _read_pose(file: Path) -> np.ndarray | None:
    try:
        pose = np.array(file.read_text(encoding="utf-8-sig").replace(",", " ").split(), np.float64).reshape(4, 4)
    except ValueError:
        raise InputError(f"`{file}`: expected a 4 x 4 matrix of numbers, camera to world") from None
    if not np.isfinite(pose).all():
        warnings.warn(f"`{file}` has a NaN or an infinity; left out of the truth", InputWarning, stacklevel=3)
        return None
    return pose
