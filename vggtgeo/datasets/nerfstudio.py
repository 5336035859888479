"""`transforms.json` with images: of nerfstudio, instant-ngp, and the apps that export for them (Polycam, Record3D).

| key, of the file or of a frame | meaning |
|---|---|
| `frames`: `file_path`, `transform_matrix` | image, and camera -> world, OpenGL's axes (x right, y up, z backward) |
| `depth_file_path` or `depth_path` of a frame | 16-bit depth, millimetres, or `integer_depth_scale` metres a unit |
| `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, `k1` ... `p2` | the camera; pixel (0, 0) is the corner of the top-left pixel |
| `camera_model`, `is_fisheye` | the lens: a pinhole, distorted or not, or a fisheye of `k1` ... `k4` |
| `camera_angle_x` | field of view, radians, where there is no focal length |

The poses are those of another program (COLMAP, ARKit), often of free scale, not an independent ground truth.
"""

import math
import os
import statistics
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from vggtgeo.datasets.folder import FolderSequence, enlarged
from vggtgeo.datasets.image_files import IMAGE_SUFFIXES, MILLIMETRES, read_depth
from vggtgeo.datasets.images import FRAMES_PER_SECOND, natural_key
from vggtgeo.datasets.intrinsics import guess_with_warning, intrinsics_of
from vggtgeo.datasets.pose_files import read_json, trajectory_of
from vggtgeo.geometry.camera import Camera, check_distortion
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning

FILE = "transforms.json"
FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera axes to OpenCV's, and back."""
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_OF_FISHEYE = ("k1", "k2", "k3", "k4")
_FISHEYE = "OPENCV_FISHEYE"
_PINHOLES = ("", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
_SAME_SHAPE = 0.01
_ONE_CAMERA = 0.02
"""Maximum relative difference of the focal lengths of one camera; autofocus changes them by less."""


@dataclass(frozen=True)
class Nerfstudio(FolderSequence):
    """Images with `transforms.json`, 30 frames a second or the given rate. Ground truth: its poses."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether `folder` has `transforms.json`."""
        return (folder / FILE).is_file()

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the frames by the numbers in their images' names; their order in the file is arbitrary."""
        file = folder / FILE
        content = _object(read_json(file), f"`{file}`")
        frames = [
            _object(frame, f"`{file}`: a frame") for frame in _listed(content.get("frames"), f"`{file}`: `frames`")
        ]
        images = {_image(folder, file, frame): frame for frame in frames}
        if not images:
            raise InputError(f"`{file}` lists no frames; expected `frames` with `file_path` and `transform_matrix`")
        if len(images) < len(frames):
            text = f"{len(frames) - len(images)} of its frames repeat an image: the last pose of each is used"
            warnings.warn(f"`{file}`: {text}", InputWarning, stacklevel=3)
        order = sorted(images, key=lambda path: natural_key(str(path.relative_to(folder))))
        rows = [
            (index / FRAMES_PER_SECOND, image, _depth(folder, file, images[image])) for index, image in enumerate(order)
        ]
        unit = _positive(file, "integer_depth_scale", content.get("integer_depth_scale", 1e-3))
        coding = replace(MILLIMETRES, units_per_metre=1.0 / unit)
        camera = lambda *size: _camera(file, content, list(images.values()), *size)
        return cls.listed(folder, rows, camera, coding, as_images=False)

    def load_depth(self, path: Path) -> np.ndarray:
        """Return the depth, enlarged to the images."""
        return enlarged(read_depth(path, self.depth_format), (self.camera.width, self.camera.height), path)

    def ground_truth(self) -> Trajectory | None:
        """Return the poses of the file, camera -> world."""
        file = self.folder / FILE
        frames = {_image(self.folder, file, frame): frame for frame in read_json(file)["frames"]}
        poses = [_pose(file, frames[one.image]) for one in self.files if one.image in frames]
        times = [one.timestamp for one in self.files if one.image in frames]
        with np.errstate(invalid="ignore"):  # of infinite poses, which are left out
            return trajectory_of(times, np.array(poses) @ FROM_OPENGL, file) if poses else None

    @property
    def truth_in_metres(self) -> bool:
        """Return whether the poses are metric, as those with depth (phones); COLMAP's are not."""
        return any(one.depth is not None for one in self.files)


def _object(value: object, what: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{what} is {type(value).__name__}; expected an object")
    return value


def _listed(value: object, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{what} is {type(value).__name__}; expected a list")
    return value


def _image(folder: Path, file: Path, frame: Mapping[str, Any]) -> Path:
    """Return the image of a frame; its suffix may be missing, or changed by a conversion."""
    return _below(folder, file, "file_path", frame.get("file_path"), sorted(IMAGE_SUFFIXES))


def _depth(folder: Path, file: Path, frame: Mapping[str, Any]) -> Path | None:
    for key in ("depth_file_path", "depth_path"):
        if frame.get(key) is not None:
            return _below(folder, file, key, frame[key])
    return None


def _below(folder: Path, file: Path, key: str, name: object, endings: Collection[str] = ()) -> Path:
    """Return a file below the folder; others are never opened. A path of another place, before the folder was copied,
    is searched by its name, here and in `images`, also with other suffixes.
    """
    path = Path(name.replace("\\", "/")) if isinstance(name, str) else Path()
    if not path.name or "\0" in str(path):
        raise InputError(f"`{file}`: `{key}` of a frame is {name!r}; expected the name of a file in the folder")
    listed = [] if path.is_absolute() or ".." in path.parts else [path]
    places = [folder / place for place in (*listed, Path("images") / path.name, Path(path.name))]
    bare = lambda place: place.stem if place.suffix.lower() in endings else place.name
    others = [place.with_name(bare(place) + ending) for place in places for ending in endings]
    # Not `Path.is_file`: a name may be too long for it.
    found = next((place for place in (*places, *others) if os.path.isfile(place)), None)
    if found is None and not listed:
        raise InputError(
            f"`{file}`: `{key}` is {name!r}; expected a file below the folder of `{FILE}`: neither it nor its folder "
            f"`images` has a `{path.name}`"
        )
    return found or places[0]


def _pose(file: Path, frame: Mapping[str, Any]) -> np.ndarray:
    """Return a pose [4, 4] with OpenGL's axes; its last row may be missing."""
    try:
        pose = np.array(frame.get("transform_matrix"), np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
    if pose.shape != (4, 4):
        raise InputError(f"`{file}`: `transform_matrix` of `{frame.get('file_path')}` is no matrix of 4 x 4 numbers")
    return pose


def _camera(file: Path, content: Mapping[str, Any], frames: list[Mapping[str, Any]], width: int, height: int) -> Camera:
    """Return the camera of the file, or the median of those of its frames, for images of this size."""
    fisheye = _is_fisheye(file, content)
    across, down = (
        float(size) if stated is None else _positive(file, key, stated)
        for key, size in (("w", width), ("h", height))
        for stated in [_number(file, content, frames, key)]
    )
    focal = _focal(file, content, frames, across)
    if focal is None:
        return guess_with_warning(str(file.parent), width, height)
    fy = _number(file, content, frames, "fl_y")
    fy = focal if fy is None else fy
    cx, cy = _number(file, content, frames, "cx"), _number(file, content, frames, "cy")
    centre = (0.5 * across if cx is None else cx) - 0.5, (0.5 * down if cy is None else cy) - 0.5
    _warn_of_unread(file, content, frames, fisheye)
    lens = tuple(_number(file, content, frames, key) or 0.0 for key in (_OF_FISHEYE if fisheye else _DISTORTION))
    try:
        distortion = check_distortion(lens if fisheye or lens[4] else lens[:4]) if fisheye or any(lens) else ()
    except InputError as error:
        raise InputError(f"`{file}`: {error}") from None
    if abs(across * height - down * width) > _SAME_SHAPE * across * height:
        raise InputError(
            f"`{file}` is of images of {across:g} x {down:g} pixels; those here are {width} x {height}, which is "
            "another shape: were they turned or cut afterwards?"
        )
    camera = Camera(intrinsics_of(file, (focal, fy, *centre)), round(across), round(down), distortion, fisheye=fisheye)
    return camera.resized(width, height)


def _warn_of_unread(file: Path, content: Mapping[str, Any], frames: list[Mapping[str, Any]], fisheye: bool) -> None:
    """Warn of distortion coefficients that are not read."""
    unread = [key for key in ("k4", "k5", "k6") if not (fisheye and key == "k4")]
    if unread := [key for key in unread if _number(file, content, frames, key)]:
        text = (
            f"{', '.join(f'`{key}`' for key in unread)} of its lens, which is not read, left out: undistort the images"
        )
        warnings.warn(f"`{file}` has {text}", InputWarning, stacklevel=4)


def _is_fisheye(file: Path, content: Mapping[str, Any]) -> bool:
    """Return whether the lens is a fisheye, by `camera_model` (nerfstudio) and `is_fisheye` (instant-ngp)."""
    model, stated = str(content.get("camera_model", "")).upper(), content.get("is_fisheye")
    if model not in (*_PINHOLES, _FISHEYE):
        known = ", ".join((*_PINHOLES[1:], _FISHEYE))
        raise InputError(f"`{file}`: `camera_model` is {model}; read are {known}: undistort the images")
    if stated is None:
        return model == _FISHEYE
    if not isinstance(stated, bool) or (model and stated != (model == _FISHEYE)):
        beside = f" beside the `camera_model` {model}" if model else ""
        raise InputError(
            f"`{file}`: `is_fisheye` is {str(stated)[:40]}{beside}; expected true for {_FISHEYE}, and false for others"
        )
    return stated


def _focal(file: Path, content: Mapping[str, Any], frames: list[Mapping[str, Any]], width: float) -> float | None:
    focal = _number(file, content, frames, "fl_x")
    angle = _number(file, content, frames, "camera_angle_x")
    if focal is not None or angle is None:
        return focal
    if not 0 < angle < math.pi:
        raise InputError(f"`{file}`: `camera_angle_x` is {angle:g}; expected radians between 0 and pi")
    return 0.5 * width / math.tan(0.5 * angle)


def _number(file: Path, content: Mapping[str, Any], frames: list[Mapping[str, Any]], key: str) -> float | None:
    """Return a number of the file, else the median of the frames', else None; warn if focal lengths differ."""
    if content.get(key) is not None:
        return _finite(file, key, content[key])
    own = [_finite(file, key, frame[key]) for frame in frames if frame.get(key) is not None]
    if not own:
        return None
    middle = statistics.median(own)
    if key == "fl_x" and max(own) - min(own) > _ONE_CAMERA * abs(middle):
        warnings.warn(
            f"`{file}`: focal lengths of its frames go from {min(own):g} to {max(own):g} pixels; one of {middle:g} is "
            "taken for all",
            InputWarning,
            stacklevel=5,
        )
    return middle


def _finite(file: Path, key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"`{file}`: `{key}` is {str(value)[:40]}; expected a number")
    return float(value)


def _positive(file: Path, key: str, value: object) -> float:
    found = _finite(file, key, value)
    if found <= 0:
        raise InputError(f"`{file}`: `{key}` is {found:g}; it must be positive")
    return found
