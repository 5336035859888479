"""Raw exports of two apps that scan with a phone's LiDAR: 3D Scanner App ("All data") and Polycam ("Raw data").

| 3D Scanner App | Polycam, below `keyframes/` | what it holds |
|---|---|---|
| `frame_00012.jpg` | `images/TIME.jpg`, or `corrected_images/` | the image; 3D Scanner App stores one of a few |
| `frame_00012.json` | `cameras/TIME.json`, or `corrected_cameras/` | camera, pose and time of the image |
| `depth_00012.png` | `depth/TIME.png`, or `corrected_depth/` | depth, millimetres, of fewer pixels and the same view |
| `conf_00012.png` | `confidence/TIME.png` | trust in it: 0 is low, larger is more |

Polycam's corrected data (refined poses, undistorted images) are preferred. Thumbnails and meshes are not read. Poses
are those of ARKit, not an independent ground truth.
"""

import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from vggtgeo.datasets.depth_files import read_depth
from vggtgeo.datasets.folder import FolderSequence, existing
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like
from vggtgeo.datasets.intrinsics import check_plausible, intrinsics_of
from vggtgeo.datasets.nerfstudio import FROM_OPENGL
from vggtgeo.datasets.phones import remove_doubtful
from vggtgeo.datasets.pose_files import parsing, read_json, trajectory_of
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning

_FRAME = re.compile(r"frame_(\d{1,9})\.(jpe?g|png)", re.IGNORECASE)
_MICROSECOND = 1e-6


class _View(NamedTuple):
    """What is known of one image. Fields: its files; time, seconds; camera, fx, fy, cx, cy; size, width and height of
    the camera's images, if stated; pose float64 [4, 4], camera -> world, OpenGL's axes.
    """

    image: Path
    depth: Path
    confidence: Path
    time: float
    camera: tuple[float, float, float, float]
    size: tuple[float, float] | None
    pose: np.ndarray


@dataclass(frozen=True)
class PhoneExport(FolderSequence):
    """Images of a phone, each with a file of camera, pose and time. Ground truth: ARKit's poses.

    poses: float64 [4, 4], camera -> world, by image. confidence: files by that of the depth.
    """

    poses: Mapping[Path, np.ndarray] = field(default_factory=dict, compare=False, repr=False)
    confidence: Mapping[Path, Path] = field(default_factory=dict, compare=False, repr=False)

    def load_depth(self, path: Path) -> np.ndarray:
        """Return the depth, enlarged to the images, without that of low confidence."""
        depth = read_depth(path, self.depth_format)
        if path in self.confidence:
            remove_doubtful(depth, self.confidence[path])
        return self.enlarge_depth(depth)

    def ground_truth(self) -> Trajectory | None:
        """Return ARKit's poses, camera -> world; the files have OpenGL's axes."""
        poses = np.array([self.poses[file.image] for file in self.files])
        with np.errstate(invalid="ignore"):  # of invalid poses, which are left out
            return trajectory_of([file.timestamp for file in self.files], poses @ FROM_OPENGL, self.folder)

    @classmethod
    def views(cls, folder: Path) -> Iterable[tuple[Path, Path, Path, Path]]:
        """Return image, file of its camera, depth and confidence of each frame, in their order."""
        raise NotImplementedError

    @classmethod
    def stated(cls, file: Path) -> tuple[float, tuple[float, float, float, float], tuple | None, np.ndarray]:
        """Return time, camera, size and pose of the file of a camera; see `_View`."""
        raise NotImplementedError

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images; raise InputError if none has a valid camera."""
        views = []
        for image, file, depth, confidence in cls.views(folder):
            try:
                views.append(_View(image, depth, confidence, *cls.stated(file)))
            except InputError as error:
                warnings.warn(LeftOutWarning(f"{error}; `{image.name}` is left out"), stacklevel=3)
        if not views:
            raise InputError(f"`{folder}` has no image with a valid file of its camera")
        times = _times(folder, [view.time for view in views])
        frames = [(time, view.image, existing(view.depth)) for time, view in zip(times, views, strict=True)]
        trusted = {view.depth: view.confidence for view in views if view.confidence.is_file()}
        poses = {view.image: view.pose for view in views}
        return cls.listed(folder, frames, lambda *size: _camera(folder, views, *size), poses=poses, confidence=trusted)


@dataclass(frozen=True)
class Scanner3d(PhoneExport):
    """An export of 3D Scanner App."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has an image `frame_N` beside its JSON."""
        return any(file.is_file() for _, file, *_ in cls.views(folder))

    @classmethod
    def views(cls, folder: Path) -> Iterable[tuple[Path, Path, Path, Path]]:
        for image in files_like(folder, "frame_*"):
            if match := _FRAME.fullmatch(image.name):
                number = match[1]
                depth, confidence = folder / f"depth_{number}.png", folder / f"conf_{number}.png"
                yield image, folder / f"frame_{number}.json", depth, confidence

    @classmethod
    def stated(cls, file: Path) -> tuple[float, tuple[float, float, float, float], tuple | None, np.ndarray]:
        with parsing(file, "`intrinsics` of 9 numbers, `cameraPoseARFrame` of 16, and `time`"):
            content = read_json(file)
            matrix = np.reshape(content["intrinsics"], (3, 3)).astype(np.float64)
            matrix = matrix if matrix[0, 2] or matrix[1, 2] else matrix.T  # by columns, as ARKit has it
            pose = np.reshape(content["cameraPoseARFrame"], (4, 4)).astype(np.float64)
            pose = pose.T if pose[3, :3].any() and not pose[:3, 3].any() else pose
            camera = intrinsics_of(file, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
            return float(content["time"]), camera, None, pose


@dataclass(frozen=True)
class Polycam(PhoneExport):
    """A raw export of Polycam."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder`, or `keyframes` in it, has images with their cameras."""
        return next(iter(cls.views(folder)), None) is not None

    @classmethod
    def views(cls, folder: Path) -> Iterable[tuple[Path, Path, Path, Path]]:
        for place in (folder / "keyframes", folder):
            for kind in ("corrected_", ""):
                cameras = place / f"{kind}cameras"
                if any(cameras.glob("*.json")):
                    depth = place / f"{kind}depth"
                    depth = depth if depth.is_dir() else place / "depth"
                    for image in files_like(place / f"{kind}images", "*.jpg"):
                        name = f"{image.stem}.png"
                        yield image, cameras / f"{image.stem}.json", depth / name, place / "confidence" / name
                    return

    @classmethod
    def stated(cls, file: Path) -> tuple[float, tuple[float, float, float, float], tuple | None, np.ndarray]:
        with parsing(file, "`fx`, `fy`, `cx`, `cy`, `width`, `height` and `t_00` to `t_23`"):
            content = read_json(file)
            camera = intrinsics_of(file, [content[key] for key in ("fx", "fy", "cx", "cy")])
            pose = np.eye(4)
            pose[:3] = [[content[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
            size = float(content["width"]), float(content["height"])
            return float(content.get("timestamp", file.stem)) * _MICROSECOND, camera, size, pose


def _times(folder: Path, stated: list[float]) -> list[float]:
    """Return those of the files where they rise, else 30 frames a second."""
    if np.isfinite(stated).all() and all(before < after for before, after in pairwise(stated)):
        return stated
    text = f"the times of its images do not increase; {FRAMES_PER_SECOND:g} frames a second are assumed"
    warnings.warn(f"`{folder}`: {text}", InputWarning, stacklevel=4)
    return [index / FRAMES_PER_SECOND for index in range(len(stated))]


def _camera(folder: Path, views: list[_View], width: int, height: int) -> Camera:
    """Return the median of the intrinsics of all frames; autofocus changes them by a few tenths of a per cent."""
    size = views[0].size or (width, height)
    middle = intrinsics_of(folder, np.median([view.camera for view in views], axis=0))
    camera = Camera(middle, round(size[0]), round(size[1])).resized(width, height)
    check_plausible(f"`{folder}`", camera)
    return camera
