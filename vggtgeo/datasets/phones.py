"""Recordings of phones with LiDAR: Stray Scanner (and alike) and ARKitScenes.

| | Stray Scanner | ARKitScenes |
|---|---|---|
| images | `rgb.mp4` | `lowres_wide/*_TIME.png` |
| depth, mm | `depth/NNNNNN.png`, `confidence/NNNNNN.png` 0 to 2 | `lowres_depth/*_TIME.png` |
| camera | `camera_matrix.csv` | `lowres_wide_intrinsics/*.pincam` |
| poses | `odometry.csv` | `lowres_wide.traj` |

The depth has 256 x 192 pixels of the same view; it is enlarged to the images without interpolation. Poses are those of
ARKit, not an independent ground truth: differences from them are not errors.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.datasets.depth_files import MILLIMETRES, read_codes, read_depth
from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.images import files_like
from vggtgeo.datasets.intrinsics import intrinsics_of
from vggtgeo.datasets.pose_files import poses_of, read_matrices, read_matrix, trajectory_of
from vggtgeo.datasets.video import VideoFile
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.text_files import whole_text

LARGEST = 960
"""Maximum pixels of the longer side: the depth has 256, and images of 1920 cost four times as much."""
_MIN_CONFIDENCE = 1
"""Minimum of 0 (low), 1 and 2; Polycam writes 0, 127 and 255."""
_CONFIDENCE = "confidence"
_LISTS = "odometry.csv", "camera_matrix.csv"
"""Files of Stray Scanner beside the video."""
_MAX_DELAY = 0.02


@dataclass(frozen=True)
class StrayScanner:
    """A folder of Stray Scanner. Ground truth: ARKit's odometry."""

    folder: Path
    name: str
    camera: Camera
    video: VideoFile = field(repr=False)
    times: tuple[float, ...] = field(repr=False)
    has_depth: bool = True

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has `rgb.mp4` and one of the two lists (a recording without the other is damaged)."""
        return (folder / "rgb.mp4").is_file() and any((folder / name).is_file() for name in _LISTS)

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Open the video; images are reduced to at most 960 pixels, by an integer factor."""
        for file in (folder / name for name in _LISTS):
            if not file.is_file():
                raise InputError(f"`{file}` is missing: copy the whole recording, or give `rgb.mp4` alone, as a video")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)  # the video has no intrinsics, but the folder has
            video = VideoFile.open(folder / "rgb.mp4", depth=False)
        width, height = video.camera.width, video.camera.height
        reduction = -(-max(width, height) // LARGEST)
        file = folder / "camera_matrix.csv"
        matrix = read_matrix(file, (3, 3))
        # pixel (0, 0) is the centre of the corner pixel, not the corner
        centre = (matrix[:2, 2] + 0.5) / reduction - 0.5
        intrinsics = intrinsics_of(file, (matrix[0, 0] / reduction, matrix[1, 1] / reduction, *centre))
        camera = Camera(intrinsics, width // reduction, height // reduction)
        times = tuple(_odometry(folder)[:, 0].tolist())
        if len(video) and len(times) != len(video):
            warnings.warn(
                f"`{folder}`: `rgb.mp4` has {len(video)} frames, `odometry.csv` {len(times)} times; frames behind "
                f"{min(len(video), len(times))} are left out",
                InputWarning,
                stacklevel=3,
            )
        has_depth = bool(files_like(folder / "depth", "*.png"))
        return cls(folder, folder.resolve().name, camera, video, times, has_depth)

    def __len__(self) -> int:
        return min(len(self.video), len(self.times))

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`."""
        check_selection(self.name, len(self), start, end, stride)
        end = len(self) if end is None else min(end, len(self))
        return (self._frame(frame) for frame in self.video.frames(start, end, stride))

    def ground_truth(self) -> Trajectory | None:
        """Return ARKit's poses, camera -> world, which the app writes with OpenCV's axes."""
        rows = _odometry(self.folder)
        return trajectory_of(rows[:, 0], poses_of(rows[:, 2:5], rows[:, 5:9]), self.folder / "odometry.csv")

    def _frame(self, frame: Frame) -> Frame:
        size = (self.camera.width, self.camera.height)
        image = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        depth = self._depth(frame.index) if self.has_depth else None
        return Frame(frame.index, self.times[frame.index], np.asarray(image, np.uint8), depth, frame.name)

    def _depth(self, index: int) -> np.ndarray:
        shape = (self.camera.height, self.camera.width)
        file = self.folder / "depth" / f"{index:06d}.png"
        try:
            depth = read_depth(file, MILLIMETRES)
            if (self.folder / _CONFIDENCE).is_dir():
                remove_doubtful(depth, self.folder / _CONFIDENCE / file.name)
            depth = cv2.resize(depth, (self.camera.width, self.camera.height), interpolation=cv2.INTER_NEAREST_EXACT)
            return np.asarray(depth, np.float32)
        except InputError as error:
            warnings.warn(f"{error}; the frame is used without depth", InputWarning, stacklevel=3)
            return np.full(shape, np.nan, np.float32)


def remove_doubtful(depth: np.ndarray, file: Path) -> None:
    """Replace depth of low confidence by NaN; warn if the confidence cannot be read, and keep all depth."""
    try:
        trust = read_codes(file)
        if trust.shape != depth.shape:
            raise InputError(f"`{file}` has shape {trust.shape}, its depth {depth.shape}")
    except InputError as error:
        warnings.warn(f"{error}; all depth of the frame is used", InputWarning, stacklevel=4)
    else:
        depth[trust < _MIN_CONFIDENCE] = np.nan


@dataclass(frozen=True)
class ArkitScenes(FolderSequence):
    """A folder of ARKitScenes, low-resolution images. Truth: ARKit's own poses."""

    depth_of_fewer_pixels = True

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has `lowres_wide`."""
        return (folder / "lowres_wide").is_dir()

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images, and pair each with the depth nearest in time."""
        images = _timed(folder / "lowres_wide")
        if not images:
            raise InputError(f"`{folder}/lowres_wide` has no images named `..._SECONDS.png`")
        depths = _timed(folder / "lowres_depth") if (folder / "lowres_depth").is_dir() else []
        frames = [(time, image, _nearest(time, depths)) for time, image in images]
        return cls.listed(folder, frames, lambda *size: _pincam(folder, *size))

    def ground_truth(self) -> Trajectory | None:
        """Return ARKit's poses; the file has world -> camera as rotation vectors and translations."""
        file = self.folder / "lowres_wide.traj"
        if not file.is_file():
            return None
        rows = read_matrices(file, 7)
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(rows[:, 1:4]).as_matrix()
        poses[:, :3, 3] = rows[:, 4:]
        return trajectory_of(rows[:, 0], np.linalg.inv(poses), file)


def _odometry(folder: Path) -> np.ndarray:
    """Return rows of time, frame, x, y, z, qx, qy, qz, qw."""
    file = folder / "odometry.csv"
    text = [line for line in whole_text(file).splitlines() if line.strip()]
    header = text[0].split(",") if text else []
    rows = read_matrices(file, len(header), skip="t") if header else np.zeros((0, 9))
    if rows.shape[1] < 9 or not len(rows):
        raise InputError(f"`{file}`: expected lines `timestamp, frame, x, y, z, qx, qy, qz, qw` after a head")
    return rows


def _timed(folder: Path) -> list[tuple[float, Path]]:
    found = []
    for path in files_like(folder, "*.png"):
        try:
            found.append((float(path.stem.rsplit("_", 1)[-1]), path))
        except ValueError:
            continue
    return sorted(found)


def _nearest(time: float, depths: list[tuple[float, Path]]) -> Path | None:
    if not depths:
        return None
    other, path = min(depths, key=lambda entry: abs(entry[0] - time))
    return path if abs(other - time) <= _MAX_DELAY else None


def _pincam(folder: Path, width: int, height: int) -> Camera:
    """Return the median of the intrinsics of all frames; autofocus changes them by a few tenths of a per cent."""
    files = files_like(folder / "lowres_wide_intrinsics", "*.pincam")
    if not files:
        raise InputError(f"`{folder}/lowres_wide_intrinsics` has no `.pincam` file: width height fx fy cx cy")
    rows = np.concatenate([read_matrices(file, 6)[:1] for file in files])
    if (rows[:, :2] != (width, height)).any():
        raise InputError(
            f"`{files[0]}` is for {rows[0, 0]:g} x {rows[0, 1]:g} pixels; the images are {width} x {height}"
        )
    fx, fy, cx, cy = np.median(rows[:, 2:], axis=0)
    return Camera(intrinsics_of(files[0].parent, (fx, fy, cx, cy)), width, height)
