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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from vggtgeo.datasets.folder import FolderSequence, enlarged, existing
from vggtgeo.datasets.image_files import read_depth
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like
from vggtgeo.datasets.intrinsics import check_plausible, intrinsics_of
from vggtgeo.datasets.nerfstudio import FROM_OPENGL
from vggtgeo.datasets.phones import leave_out_doubtful
from vggtgeo.datasets.pose_files import read_json, trajectory_of
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning

_FRAME = re.compile(r"frame_(\d{1,9})\.(jpe?g|png)", re.IGNORECASE)
_MICROSECOND = 1e-6
_ONE_CAMERA = 0.02
"""Maximum relative difference of the focal lengths of one camera; autofocus changes them by less."""
_SAME_SHAPE = 0.01
_UNKNOWN = np.full((4, 4), np.nan)


class _Stated(NamedTuple):
    """Content of a JSON file of one image: time, seconds, NaN if unknown; camera, fx, fy, cx, cy; size, width and
    height, if stated; pose float64 [4, 4], camera -> world, OpenGL's axes, NaN if invalid.
    """

    time: float
    camera: tuple[float, float, float, float]
    size: tuple[int, int] | None
    pose: np.ndarray


class _Part(NamedTuple):
    """The files of one image."""

    image: Path
    stated: Path
    depth: Path
    confidence: Path


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
            leave_out_doubtful(depth, self.confidence[path])
        return enlarged(depth, (self.camera.width, self.camera.height), path)

    def ground_truth(self) -> Trajectory | None:
        """Return ARKit's poses, camera -> world; the files have OpenGL's axes."""
        if not self.files:
            return None
        poses = np.array([self.poses[file.image] for file in self.files])
        with np.errstate(invalid="ignore"):  # of invalid poses, which are left out
            return trajectory_of([file.timestamp for file in self.files], poses @ FROM_OPENGL, self.folder)

    @classmethod
    def _of_parts(cls, folder: Path, parts: Iterable[_Part], read: Callable[[Path], _Stated]) -> Self:
        known = [(part, stated) for part in parts if (stated := _read(part, read)) is not None]
        if not known:
            raise InputError(f"`{folder}` has no image with a valid file of its camera")
        times = _times(folder, [stated.time for _, stated in known])
        frames = [(time, part.image, existing(part.depth)) for time, (part, _) in zip(times, known, strict=True)]
        trusted = {part.depth: part.confidence for part, _ in known if part.confidence.is_file()}
        if not trusted and any(depth is not None for _, _, depth in frames):
            _warn(f"`{folder}` has no confidence beside its depth: all depth is used")
        poses = {part.image: stated.pose for part, stated in known}
        camera = lambda *size: _camera(folder, [stated for _, stated in known], *size)
        return cls.listed(folder, frames, camera, as_images=False, poses=poses, confidence=trusted)


@dataclass(frozen=True)
class Scanner3d(PhoneExport):
    """An export of 3D Scanner App."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has an image `frame_N` beside its JSON."""
        return any(image.with_suffix(".json").is_file() for image in _frames(folder).values())

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images by their numbers; raise InputError if none has a camera."""
        parts = [
            _Part(image, *(image.with_name(f"{what}_{number}{end}") for what, end in _SCANNER_PARTS))
            for number, image in _frames(folder).items()
        ]
        return cls._of_parts(folder, parts, _of_scanner)


@dataclass(frozen=True)
class Polycam(PhoneExport):
    """A raw export of Polycam."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder`, or `keyframes` in it, has images with their cameras."""
        return _keyframes(folder) is not None

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images by their times; raise InputError if none has a camera."""
        place = _keyframes(folder)
        if place is None:
            raise InputError(
                f"`{folder}` has no `keyframes/images` and `keyframes/cameras`; expected Polycam's raw data"
            )
        corrected = "corrected_" if _is_of_polycam(place, "corrected_") else ""
        depth = place / f"{corrected}depth"
        depth = depth if depth.is_dir() else place / "depth"
        parts = [
            _Part(
                image,
                place / f"{corrected}cameras" / f"{image.stem}.json",
                depth / f"{image.stem}.png",
                place / "confidence" / f"{image.stem}.png",
            )
            for image in files_like(place / f"{corrected}images", "*.jpg")
        ]
        return cls._of_parts(folder, parts, _of_polycam)


_SCANNER_PARTS = ("frame", ".json"), ("depth", ".png"), ("conf", ".png")


def _frames(folder: Path) -> dict[str, Path]:
    found = ((_FRAME.fullmatch(path.name), path) for path in files_like(folder, "frame_*"))
    return {match[1]: path for match, path in found if match}


def _keyframes(folder: Path) -> Path | None:
    places = (place for place in (folder / "keyframes", folder) if place.is_dir())
    return next((one for one in places if _is_of_polycam(one, "corrected_") or _is_of_polycam(one, "")), None)


def _is_of_polycam(place: Path, corrected: str) -> bool:
    images, cameras = place / f"{corrected}images", place / f"{corrected}cameras"
    return images.is_dir() and any(cameras.glob("*.json"))


def _read(part: _Part, read: Callable[[Path], _Stated]) -> _Stated | None:
    """Read the file of an image; None, with a warning, if it is invalid: the image is left out."""
    try:
        return read(part.stated)
    except InputError as error:
        warnings.warn(LeftOutWarning(f"{error}; `{part.image.name}` is left out"), stacklevel=5)
        return None


def _of_scanner(file: Path) -> _Stated:
    content = _object(file)
    values = _numbers(file, content, "intrinsics", 9).reshape(3, 3)
    values = values if values[0, 2] or values[1, 2] else values.T  # by columns, as ARKit has it
    pose = (
        np.array(content.get("cameraPoseARFrame", ()), np.float64) if _is_list(content, "cameraPoseARFrame") else None
    )
    pose = _UNKNOWN if pose is None or pose.size != 16 else pose.reshape(4, 4)
    pose = pose.T if pose[3, :3].any() and not pose[:3, 3].any() else pose
    camera = intrinsics_of(file, (values[0, 0], values[1, 1], values[0, 2], values[1, 2]))
    return _Stated(_number(content, "time"), camera, None, pose)


def _of_polycam(file: Path) -> _Stated:
    content = _object(file)
    camera = intrinsics_of(file, [content.get(key) for key in ("fx", "fy", "cx", "cy")])
    pose = np.eye(4)
    pose[:3] = [[_number(content, f"t_{row}{column}") for column in range(4)] for row in range(3)]
    # Corrected cameras have no times.
    other = file.parent.parent / "cameras" / file.name
    time = _number(content, "timestamp")
    if np.isnan(time) and other != file and other.is_file():
        time = _number(_object(other), "timestamp")
    time = float(file.stem) if np.isnan(time) and file.stem.isdigit() else time
    width, height = _number(content, "width"), _number(content, "height")
    size = (round(width), round(height)) if width >= 1 and height >= 1 else None
    return _Stated(time * _MICROSECOND, camera, size, pose)


def _object(file: Path) -> Mapping[str, Any]:
    content = read_json(file)
    if not isinstance(content, dict):
        raise InputError(f"`{file}` holds {type(content).__name__}; expected an object with a camera")
    return content


def _number(content: Mapping[str, Any], key: str) -> float:
    value = content.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else np.nan


def _is_list(content: Mapping[str, Any], key: str) -> bool:
    value = content.get(key)
    return isinstance(value, list) and all(isinstance(one, int | float) for one in value)


def _numbers(file: Path, content: Mapping[str, Any], key: str, count: int) -> np.ndarray:
    if not _is_list(content, key) or len(content[key]) != count:
        raise InputError(f"`{file}`: `{key}` is {str(content.get(key))[:40]}; expected {count} numbers")
    return np.array(content[key], np.float64)


def _times(folder: Path, stated: list[float]) -> list[float]:
    """Return those of the files where they rise, else 30 frames a second."""
    if np.isfinite(stated).all() and all(before < after for before, after in pairwise(stated)):
        return stated
    _warn(f"`{folder}`: the times of its images do not increase; {FRAMES_PER_SECOND:g} frames a second are assumed")
    return [index / FRAMES_PER_SECOND for index in range(len(stated))]


def _camera(folder: Path, stated: list[_Stated], width: int, height: int) -> Camera:
    """Return the median of the intrinsics of all frames; autofocus changes them by a few tenths of a per cent."""
    rows = np.array([one.camera for one in stated])
    middle = np.median(rows, axis=0)
    low, high = rows[:, 0].min(), rows[:, 0].max()
    if high - low > _ONE_CAMERA * middle[0]:
        _warn(
            f"`{folder}`: focal lengths of its frames go from {low:g} to {high:g} pixels; one of {middle[0]:g} is "
            "taken for all"
        )
    across, down = next((one.size for one in stated if one.size), (width, height))
    if abs(across * height - down * width) > _SAME_SHAPE * across * height:
        raise InputError(
            f"`{folder}` has cameras of images of {across} x {down} pixels; those here are {width} x {height}, which "
            "is another shape: were they turned or cut afterwards?"
        )
    camera = Camera(intrinsics_of(folder, middle), across, down).resized(width, height)
    check_plausible(f"`{folder}`", camera)
    return camera


def _warn(message: str) -> None:
    warnings.warn(message, InputWarning, stacklevel=5)
