"""7-Scenes folders: `frame-XXXXXX.color.png|jpg`, `.depth.png`, `.pose.txt`, numbered at 30 frames/s.

As published, a folder has no intrinsics, depth (65535 means none, too) is not registered to the colour images, and
poses are those of the depth camera. If a folder has no intrinsics, or those of the depth camera (f = 585, as in the
copy of TSDF Fusion), depth and poses are transformed to the colour camera. The extrinsics are those that are usual for
these scenes (LIRIS, https://projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html). They were
calibrated with another Kinect, so near objects have errors of some pixels.

Source: J. Shotton et al., "Scene coordinate regression forests", CVPR 2013.
"""

import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from vggtgeo.datasets.depth_registration import DepthRegistration
from vggtgeo.datasets.folder import FolderSequence, existing
from vggtgeo.datasets.intrinsics import camera_from_folder, guess_with_warning
from vggtgeo.datasets.pose_files import read_matrix, trajectory_of
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import NoteWarning, warn

FRAMES_PER_SECOND = 30.0
COLOUR_TRUTH = "groundtruth-colour.txt"
_COLOUR = re.compile(r"frame-(\d+)\.color\.(?:png|jpe?g)")
_KINECT = (525.0, 525.0, 320.0, 240.0)
_AS_PUBLISHED = Camera(_KINECT, 640, 480)
_KINECT_DEPTH = (585.0, 585.0, 320.0, 240.0)
_TO_COLOUR = np.array(
    [
        [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03, -2.5558943178152542e-02],
        [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03, 1.0109636268061706e-04],
        [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01, 2.0318321729487039e-03],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Depth camera -> colour camera."""


@dataclass(frozen=True)
class SevenScenes(FolderSequence):
    """One sequence. Ground truth: `groundtruth-colour.txt` (TUM format) if present, else the pose files.

    as_published: whether depth and pose files belong to the depth camera.
    """

    as_published: bool = False

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return bool(_colour_files(folder)) or bool(_sequences(folder))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the frames; in a folder of sequences those of the first, with a warning if there are more."""
        if not _colour_files(folder):
            folder = _first_sequence(folder)
        numbered = _colour_files(folder)
        frames = [
            (number / FRAMES_PER_SECOND, image, existing(_beside(image, "depth.png")))
            for number, image in sorted(numbered.items())
        ]
        sequence = cls.listed(folder, frames, lambda *size: _camera(folder, *size))
        return replace(sequence, as_published=sequence.camera is _AS_PUBLISHED)

    def load_depth(self, path: Path) -> np.ndarray:
        """Return the depth, registered to the colour camera."""
        depth = super().load_depth(path)
        return self._registration(depth) if self.as_published else depth

    @cached_property
    def _registration(self) -> DepthRegistration:
        source = Camera(_KINECT_DEPTH, self.camera.width, self.camera.height)
        return DepthRegistration.of(source, self.camera, _TO_COLOUR)

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses; warn of pose files with NaN or infinity (lost tracking), which are left out."""
        if (self.folder / COLOUR_TRUTH).exists():
            return Trajectory.load_tum(self.folder / COLOUR_TRUTH)
        files = {file.timestamp: _beside(file.image, "pose.txt") for file in self.files}
        poses = {time: read_matrix(file, (4, 4)) for time, file in files.items() if file.is_file()}
        if not poses:
            return None
        to_camera = np.linalg.inv(_TO_COLOUR) if self.as_published else np.eye(4)
        with np.errstate(invalid="ignore"):  # of lost frames, which have NaN
            return trajectory_of(list(poses), np.array(list(poses.values())) @ to_camera, self.folder)


def _colour_files(folder: Path) -> dict[int, Path]:
    found = ((match, path) for path in sorted(folder.iterdir()) if (match := _COLOUR.fullmatch(path.name)))
    return {int(match.group(1)): path for match, path in found}


def _sequences(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("seq-*")) if path.is_dir() and _colour_files(path)]


def _first_sequence(folder: Path) -> Path:
    sequences = _sequences(folder)
    if len(sequences) > 1:
        warn(f"`{folder}` holds {len(sequences)} sequences; reading `{sequences[0].name}`: give the folder of another")
    return sequences[0] if sequences else folder


def _beside(image: Path, suffix: str) -> Path:
    return image.with_name(f"{image.name.split('.')[0]}.{suffix}")


def _camera(folder: Path, width: int, height: int) -> Camera:
    own = camera_from_folder(folder, width, height)
    if own is not None and own.intrinsics != _KINECT_DEPTH:  # not the colour camera, see above
        return own
    if (width, height) != (640, 480):
        return guess_with_warning(str(folder), width, height)
    warn(
        f"`{folder}` has no intrinsics of its colour camera: those of a Kinect, {_KINECT}, are used; depth and poses "
        "belong to the depth camera (f = 585) and are transformed to the colour camera with a generic calibration",
        NoteWarning,
    )
    return _AS_PUBLISHED
