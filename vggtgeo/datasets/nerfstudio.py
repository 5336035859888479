"""Images with a `transforms.json`: nerfstudio, instant-ngp, and apps that export for them (Polycam, Record3D).

| key, of the file or of a frame | meaning |
|---|---|
| `frames`: `file_path`, `transform_matrix` | image, and camera -> world, OpenGL's axes (x right, y up, z backward) |
| `depth_file_path` or `depth_path` of a frame | 16-bit depth, millimetres, or `integer_depth_scale` metres a unit |
| `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, `k1` ... `p2` | the camera; pixel (0, 0) is the corner of the top-left pixel |
| `camera_model`, `is_fisheye` | the lens: a pinhole, distorted or not, or a fisheye of `k1` ... `k4` |
| `camera_angle_x` | field of view, radians, used without a focal length |

The poses were estimated by another program (COLMAP, ARKit), often with unknown scale. They are not an independent
ground truth.
"""

import math
import statistics
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.image_files import IMAGE_SUFFIXES, MILLIMETRES, path_exists
from vggtgeo.datasets.images import FRAMES_PER_SECOND, natural_key
from vggtgeo.datasets.intrinsics import guess_with_warning, intrinsics_of, is_fisheye
from vggtgeo.datasets.pose_files import parsing, read_json, trajectory_of
from vggtgeo.geometry.camera import Camera, check_distortion
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, warn

FILE = "transforms.json"
FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Changes camera axes from OpenGL's to OpenCV's, and back."""
_EXPECTED = "`frames` with `file_path` and `transform_matrix` (4 x 4 numbers), and the camera as nerfstudio writes it"
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE_DISTORTION = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class Nerfstudio(FolderSequence):
    """Images with `transforms.json`, 30 frames a second or the given rate. Ground truth: its poses."""

    depth_of_fewer_pixels = True

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return (folder / FILE).is_file()

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the frames in the order of their images' names; their order in the file is arbitrary."""
        file = folder / FILE
        with parsing(file, _EXPECTED):
            content = read_json(file)
            images = _images(folder, content)
            order = sorted(images, key=lambda path: natural_key(str(path.relative_to(folder))))
            rows = [
                (index / FRAMES_PER_SECOND, image, _depth(folder, images[image])) for index, image in enumerate(order)
            ]
            coding = replace(MILLIMETRES, units_per_metre=1.0 / float(content.get("integer_depth_scale", 1e-3)))
            for frame in images.values():
                _pose(frame)  # invalid poses are reported here, not after the run
        camera = lambda *size: _camera(file, content, list(images.values()), *size)
        return cls.listed(folder, rows, camera, coding)

    def ground_truth(self) -> Trajectory | None:
        file = self.folder / FILE
        frames = _images(self.folder, read_json(file))
        poses = np.array([_pose(frames[one.image]) for one in self.files])
        with np.errstate(invalid="ignore"):  # of infinite poses, which are left out
            return trajectory_of([one.timestamp for one in self.files], poses @ FROM_OPENGL, file)

    @property
    def truth_in_metres(self) -> bool:
        """Return whether the poses are metric: they are with depth (phones); COLMAP's are not."""
        return any(one.depth is not None for one in self.files)


def _images(folder: Path, content: Mapping[str, Any]) -> dict[Path, Mapping[str, Any]]:
    """Return the frames by image file; the suffix in `file_path` may be missing, or that of another format."""
    return {_find_inside(folder, frame["file_path"], IMAGE_SUFFIXES): frame for frame in content["frames"]}


def _depth(folder: Path, frame: Mapping[str, Any]) -> Path | None:
    name = frame.get("depth_file_path") or frame.get("depth_path")
    return None if name is None else _find_inside(folder, name)


def _find_inside(folder: Path, name: str, suffixes: Collection[str] = ()) -> Path:
    """Return a file inside the folder; files outside are never opened.

    A path that does not exist inside, since the folder was moved, is searched by its file name in the folder and in
    `images`, also with other suffixes.
    """
    path = Path(name.replace("\\", "/"))
    inside = not path.is_absolute() and ".." not in path.parts
    places = [folder / place for place in ([path] if inside else []) + [Path("images") / path.name, Path(path.name)]]
    stems = [place.with_suffix("") if path.suffix.lower() in suffixes else place for place in places]
    converted = [Path(f"{stem}{suffix}") for stem in stems for suffix in sorted(suffixes)]
    found = next(filter(path_exists, [*places, *converted]), None)
    if found is None and not inside:
        raise InputError(f"`{folder}`: {name!r} of `{FILE}` does not exist inside the folder")
    return found or places[0]


def _pose(frame: Mapping[str, Any]) -> np.ndarray:
    """Return a pose [4, 4] with OpenGL's axes; its last row may be missing."""
    pose = np.eye(4)
    given = np.array(frame["transform_matrix"], np.float64)
    pose[: len(given)] = given.reshape(-1, 4)
    return pose


def _camera(file: Path, content: Mapping[str, Any], frames: list[Mapping[str, Any]], width: int, height: int) -> Camera:
    """Return the camera of the file, or the median of its frames' cameras, for images of this size."""

    def number(key: str, default: float = 0.0) -> float:
        places = (content,) if content.get(key) is not None else frames
        stated = [float(one[key]) for one in places if one.get(key) is not None]
        return statistics.median(stated) if stated else default

    with parsing(file, _EXPECTED):
        across, down = number("w", width), number("h", height)
        angle = number("camera_angle_x")
        fx = number("fl_x", 0.5 * across / math.tan(0.5 * angle) if 0 < angle < math.pi else 0.0)
        if not fx and not {"fl_x", "camera_angle_x"} & {*content, *(key for frame in frames for key in frame)}:
            return guess_with_warning(str(file.parent), width, height)
        centre = number("cx", 0.5 * across) - 0.5, number("cy", 0.5 * down) - 0.5
        named = is_fisheye(f"`{file}`: `camera_model`", str(content.get("camera_model", "")))
        fisheye = named or content.get("is_fisheye") is True  # nerfstudio, instant-ngp
        if unread := [key for key in ("k4", "k5", "k6") if number(key) and not (fisheye and key == "k4")]:
            warn(f"`{file}`: the coefficients {', '.join(unread)} are not supported and ignored: undistort the images")
        lens = tuple(map(number, _FISHEYE_DISTORTION if fisheye else _DISTORTION))
        distortion = check_distortion(lens if fisheye or lens[4] else lens[:4]) if fisheye or any(lens) else ()
        intrinsics = intrinsics_of(file, (fx, number("fl_y", fx), *centre))
    return Camera(intrinsics, round(across), round(down), distortion, fisheye=fisheye).resized(width, height)
