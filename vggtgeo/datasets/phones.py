"""Recordings of phones with LiDAR: Stray Scanner (and alike), ARKitScenes, and the raw exports of two apps: 3D Scanner
App ("All data") and Polycam ("Raw data", below `keyframes/`).

| | Stray Scanner | ARKitScenes | 3D Scanner App | Polycam |
|---|---|---|---|---|
| images | `rgb.mp4` | `lowres_wide/*_TIME.png` | `frame_00012.jpg`, one of a few | `images/TIME.jpg` |
| depth, mm | `depth/NNNNNN.png` | `lowres_depth/*_TIME.png` | `depth_00012.png` | `depth/TIME.png` |
| confidence: 0 is low | `confidence/NNNNNN.png` | | `conf_00012.png` | `confidence/TIME.png` |
| camera | `camera_matrix.csv` | `lowres_wide_intrinsics/*.pincam` | `frame_00012.json` | `cameras/TIME.json` |
| poses | `odometry.csv` | `lowres_wide.traj` | the same | the same |

The depth has a lower resolution (256 x 192); it is enlarged to the images without interpolation. Polycam's corrected
data (`corrected_images/`, ...: refined poses, undistorted images) are preferred. Thumbnails and meshes are not read.
Poses are estimates of ARKit, not an independent ground truth: differences from them are not errors.
"""

import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Self

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.datasets.folder import FolderSequence, existing
from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.image_files import MILLIMETRES, read_codes, read_depth
from vggtgeo.datasets.images import files_like, partners_in_time
from vggtgeo.datasets.intrinsics import intrinsics_of
from vggtgeo.datasets.nerfstudio import FROM_OPENGL
from vggtgeo.datasets.pose_files import check_size, parsing, read_json, read_matrix, trajectory_of
from vggtgeo.datasets.video import VideoFile
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory, poses_of, read_matrices
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning, warn
from vggtgeo.io.files import whole_text

MAX_SIDE = 960
"""Maximum pixels of the longer side of an image: the depth has only 256, and 1920 pixels cost four times as much."""
_MIN_CONFIDENCE = 1
"""Minimum confidence of depth that is used. Apps write 0 (low), 1 and 2; Polycam 0, 127 and 255."""
_CONFIDENCE = "confidence"
_LISTS = "odometry.csv", "camera_matrix.csv"
"""Files of Stray Scanner beside the video."""
_FRAME = re.compile(r"frame_(\d{1,9})\.(jpe?g|png)", re.IGNORECASE)


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
        return (folder / "rgb.mp4").is_file() and any((folder / name).is_file() for name in _LISTS)

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Open the video; images are reduced to at most 960 pixels, by an integer factor."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)  # of missing intrinsics, which the folder has
            video = VideoFile.open(folder / "rgb.mp4", depth=False)
        width, height = video.camera.width, video.camera.height
        reduction = -(-max(width, height) // MAX_SIDE)
        file = folder / "camera_matrix.csv"
        matrix = read_matrix(file, (3, 3))
        # Coordinates (0, 0) are the centre of the corner pixel, not the corner of the image.
        centre = (matrix[:2, 2] + 0.5) / reduction - 0.5
        intrinsics = intrinsics_of(file, (matrix[0, 0] / reduction, matrix[1, 1] / reduction, *centre))
        camera = Camera(intrinsics, width // reduction, height // reduction)
        times = tuple(_odometry(folder)[:, 0].tolist())
        if len(times) != len(video):
            text = f"has {len(video)} frames, `odometry.csv` {len(times)} times"
            warn(f"`{folder}`: `rgb.mp4` {text}; frames from {min(len(video), len(times))} on are left out")
        has_depth = bool(files_like(folder / "depth", "*.png"))
        return cls(folder, folder.resolve().name, camera, video, times, has_depth)

    def __len__(self) -> int:
        return min(len(self.video), len(self.times))

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        check_selection(self.name, len(self), start, end, stride)
        end = len(self) if end is None else min(end, len(self))
        return map(self._frame, self.video.frames(start, end, stride))

    def ground_truth(self) -> Trajectory | None:
        """Return ARKit's poses, camera -> world, which the app writes with OpenCV's axes."""
        rows = _odometry(self.folder)
        return trajectory_of(rows[:, 0], poses_of(rows[:, 2:5], rows[:, 5:9]), self.folder / "odometry.csv")

    def _frame(self, frame: Frame) -> Frame:
        image = cv2.resize(frame.image, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA)
        depth = self._depth(frame.index) if self.has_depth else None
        return Frame(frame.index, self.times[frame.index], np.asarray(image, np.uint8), depth, frame.name)

    def _depth(self, index: int) -> np.ndarray:
        file = self.folder / "depth" / f"{index:06d}.png"
        try:
            depth = read_depth(file, MILLIMETRES)
            if (self.folder / _CONFIDENCE).is_dir():
                remove_low_confidence(depth, self.folder / _CONFIDENCE / file.name)
            depth = cv2.resize(depth, (self.camera.width, self.camera.height), interpolation=cv2.INTER_NEAREST_EXACT)
            return np.asarray(depth, np.float32)
        except InputError as error:
            warn(f"{error}; the frame is used without depth")
            return np.full((self.camera.height, self.camera.width), np.nan, np.float32)


def remove_low_confidence(depth: np.ndarray, file: Path) -> None:
    """Replace depth of low confidence by NaN; keep all depth, with a warning, if the confidence cannot be read."""
    try:
        confidence = read_codes(file)
        if confidence.shape != depth.shape:
            raise InputError(f"`{file}` must have the shape of its depth, {depth.shape}, got {confidence.shape}")
    except InputError as error:
        warn(f"{error}; all depth of the frame is used")
    else:
        depth[confidence < _MIN_CONFIDENCE] = np.nan


@dataclass(frozen=True)
class ArkitScenes(FolderSequence):
    """A folder of ARKitScenes, low-resolution images. Truth: ARKit's own poses."""

    depth_of_fewer_pixels = True

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return (folder / "lowres_wide").is_dir()

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images, and pair each with the depth nearest in time."""
        images, depths = _timed(folder / "lowres_wide"), _timed(folder / "lowres_depth")
        frames = [
            (time, image, None if partner is None else depths[partner][1])
            for (time, image), partner in zip(images, partners_in_time(images, depths), strict=True)
        ]
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
    head = whole_text(file).strip().partition("\n")[0]
    rows = read_matrices(file, head.count(",") + 1, skip="t")
    if rows.shape[1] < 9 or not len(rows):
        raise InputError(f"`{file}`: expected lines `timestamp, frame, x, y, z, qx, qy, qz, qw` after a header")
    return rows


def _timed(folder: Path) -> list[tuple[float, Path]]:
    """Return the images named `..._SECONDS.png` with their times."""
    found = []
    for path in files_like(folder, "*.png"):
        with suppress(ValueError):
            found.append((float(path.stem.rsplit("_", 1)[-1]), path))
    return sorted(found)


def _pincam(folder: Path, width: int, height: int) -> Camera:
    """Return the median of the intrinsics of all frames; autofocus changes them by a few tenths of a per cent."""
    files = files_like(folder / "lowres_wide_intrinsics", "*.pincam")
    if not files:
        raise InputError(f"`{folder}/lowres_wide_intrinsics` has no `.pincam` file: width height fx fy cx cy")
    rows = np.concatenate([read_matrices(file, 6)[:1] for file in files])
    check_size(files[0], rows[0, :2].tolist(), (width, height))
    fx, fy, cx, cy = np.median(rows[:, 2:], axis=0)
    return Camera(intrinsics_of(files[0].parent, (fx, fy, cx, cy)), width, height)


class _View(NamedTuple):
    """Content of the camera file of an image.

    Fields: time, seconds; intrinsics, fx, fy, cx, cy; size, width and height of the images, if stated; pose float64
    [4, 4], camera -> world, OpenGL's axes.
    """

    time: float
    intrinsics: tuple[float, float, float, float]
    size: tuple[float, float] | None
    pose: np.ndarray


class _Files(NamedTuple):
    """Files of one image. camera: the file with the content of `_View`."""

    image: Path
    camera: Path
    depth: Path
    confidence: Path


@dataclass(frozen=True)
class PhoneExport(FolderSequence):
    """Images of a phone, each with a file of camera, pose and time. Ground truth: ARKit's poses.

    poses: float64 [4, 4], camera -> world, by image file. confidence: confidence files by depth file.
    """

    poses: Mapping[Path, np.ndarray] = field(default_factory=dict, compare=False, repr=False)
    confidence: Mapping[Path, Path] = field(default_factory=dict, compare=False, repr=False)

    def load_depth(self, path: Path) -> np.ndarray:
        """Return the depth, enlarged to the images, without pixels of low confidence."""
        depth = read_depth(path, self.depth_format)
        if path in self.confidence:
            remove_low_confidence(depth, self.confidence[path])
        return self.enlarge_depth(depth)

    def ground_truth(self) -> Trajectory | None:
        """Return ARKit's poses, camera -> world; the files have OpenGL's axes."""
        poses = np.array([self.poses[file.image] for file in self.files])
        with np.errstate(invalid="ignore"):  # of invalid poses, which are left out
            return trajectory_of([file.timestamp for file in self.files], poses @ FROM_OPENGL, self.folder)

    @classmethod
    def files_of(cls, folder: Path) -> Iterator[_Files]:
        """Yield the files of each image, in order."""
        raise NotImplementedError

    @classmethod
    def view_of(cls, file: Path) -> _View:
        """Read a camera file."""
        raise NotImplementedError

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return any(one.camera.is_file() for one in cls.files_of(folder))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images; those without a valid camera file are left out, with a warning."""
        views: dict[_Files, _View] = {}
        for one in cls.files_of(folder):
            try:
                views[one] = cls.view_of(one.camera)
            except InputError as error:
                warn(LeftOutWarning(f"{error}; `{one.image.name}` is left out"))
        frames = [(view.time, one.image, existing(one.depth)) for one, view in views.items()]
        camera = lambda *size: _camera(folder, list(views.values()), *size)
        poses = {one.image: view.pose for one, view in views.items()}
        trusted = {one.depth: one.confidence for one in views if one.confidence.is_file()}
        return cls.listed(folder, frames, camera, poses=poses, confidence=trusted)


@dataclass(frozen=True)
class Scanner3d(PhoneExport):
    """An export of 3D Scanner App."""

    @classmethod
    def files_of(cls, folder: Path) -> Iterator[_Files]:
        for image in files_like(folder, "frame_*"):
            if match := _FRAME.fullmatch(image.name):
                beside = (f"frame_{match[1]}.json", f"depth_{match[1]}.png", f"conf_{match[1]}.png")
                yield _Files(image, *(folder / name for name in beside))

    @classmethod
    def view_of(cls, file: Path) -> _View:
        with parsing(file, "`intrinsics` of 9 numbers, `cameraPoseARFrame` of 16, and `time`"):
            content = read_json(file)
            matrix = np.reshape(content["intrinsics"], (3, 3)).astype(np.float64)
            matrix = matrix if matrix[0, 2] or matrix[1, 2] else matrix.T  # some versions write columns, as ARKit does
            pose = np.reshape(content["cameraPoseARFrame"], (4, 4)).astype(np.float64)
            pose = pose.T if pose[3, :3].any() and not pose[:3, 3].any() else pose
            intrinsics = intrinsics_of(file, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
            return _View(float(content["time"]), intrinsics, None, pose)


@dataclass(frozen=True)
class Polycam(PhoneExport):
    """A raw export of Polycam, or `keyframes` in it."""

    @classmethod
    def files_of(cls, folder: Path) -> Iterator[_Files]:
        for place in (folder / "keyframes", folder):
            for kind in ("corrected_", ""):
                cameras = place / f"{kind}cameras"
                if any(cameras.glob("*.json")):
                    depth = place / f"{kind}depth"
                    depth = depth if depth.is_dir() else place / "depth"
                    for image in files_like(place / f"{kind}images", "*.jpg"):
                        name = f"{image.stem}.png"
                        yield _Files(image, cameras / f"{image.stem}.json", depth / name, place / "confidence" / name)
                    return

    @classmethod
    def view_of(cls, file: Path) -> _View:
        with parsing(file, "`fx`, `fy`, `cx`, `cy`, `width`, `height` and `t_00` to `t_23`"):
            content = read_json(file)
            intrinsics = intrinsics_of(file, [content[key] for key in ("fx", "fy", "cx", "cy")])
            pose = np.eye(4)
            pose[:3] = [[content[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
            size = float(content["width"]), float(content["height"])
            return _View(float(content.get("timestamp", file.stem)) * 1e-6, intrinsics, size, pose)


def _camera(folder: Path, views: list[_View], width: int, height: int) -> Camera:
    """Return the median of the intrinsics of all frames; autofocus changes them by a few tenths of a per cent."""
    size = views[0].size or (width, height)
    middle = intrinsics_of(folder, np.median([view.intrinsics for view in views], axis=0))
    return Camera(middle, round(size[0]), round(size[1])).resized(width, height)
