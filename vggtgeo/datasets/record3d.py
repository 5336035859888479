"""Recordings of the app Record3D (a phone's LiDAR or its front depth camera).

The app shares a `.r3d`, which is a zip archive, or exports "EXR + JPG". An unpacked `.r3d` is read, too.

| `.r3d` | EXR + JPG | content |
|---|---|---|
| `metadata` | `metadata.json` | size, camera (also of each frame), times, ARKit's poses: quaternion x y z w, position |
| `rgbd/0.jpg` | `rgb/0.jpg` | the image |
| `rgbd/0.depth` | `depth/0.exr` | depth, float32 metres; in a `.r3d` compressed with LZFSE |
| `rgbd/0.conf` | | confidence of the depth, uint8, 0 to 2, compressed likewise; some phones write none |

LZFSE is decoded by the package imagecodecs, EXR by OpenEXR (extra `phones`). Poses are estimates of ARKit, not an
independent ground truth.
"""

import math
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Self, cast

import numpy as np

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.image_files import MAX_BYTES, ImageFile, image_in, metres_of_floats, read_depth
from vggtgeo.datasets.images import FRAMES_PER_SECOND
from vggtgeo.datasets.intrinsics import camera_of_record3d, guess_with_warning
from vggtgeo.datasets.nerfstudio import FROM_OPENGL
from vggtgeo.datasets.pose_files import json_in, parsing, same_size, trajectory_of
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory, poses_of
from vggtgeo.io.archives import UNREADABLE
from vggtgeo.io.errors import InputError, install_hint, warn
from vggtgeo.io.files import MAX_BYTES as MAX_TEXT
from vggtgeo.io.files import content_of

SUFFIX = ".r3d"
METADATA, EXPORTED = "metadata", "metadata.json"
_IMAGE = re.compile(r"rgbd?/(\d{1,9})\.(jpe?g|png)")
_MIN_CONFIDENCE = 1
"""Minimum confidence of depth that is used: of 0 (low), 1 and 2."""


@dataclass(frozen=True)
class Record3d(FolderSequence):
    """A recording of Record3D. `folder`: the archive, or the unpacked folder. Ground truth: ARKit's poses.

    depth_size: width and height of the depth files; (0, 0) if unknown. The depth is enlarged to the images.
    """

    depth_size: tuple[int, int] = (0, 0)

    @classmethod
    def matches(cls, folder: Path) -> bool:
        """Return whether a path is a `.r3d`, or has `metadata` and `rgbd`, or `metadata.json` and EXR."""
        if folder.suffix.lower() == SUFFIX and folder.is_file():  # a truncated one is not a zip archive
            return True
        try:
            names = _names(folder)
        except UNREADABLE:
            return False
        exported = EXPORTED in names and any(name.endswith(".exr") for name in names)
        return exported or (METADATA in names and any(name.startswith("rgbd/") for name in names))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images; raise InputError if there are none, and warn of depth that cannot be read."""
        try:
            names = _names(folder)
        except UNREADABLE as error:
            raise InputError(f"`{folder}` must be a zip archive of Record3D, and is damaged: {error}") from None
        numbered = {int(match.group(1)): folder / name for name in sorted(names) if (match := _IMAGE.fullmatch(name))}
        if not names & {METADATA, EXPORTED} or not numbered:
            raise InputError(f"`{folder}` must be a recording of Record3D, with `{METADATA}` and `rgbd/0.jpg`, ...")
        numbers = sorted(numbered)
        depths = [_depth_of(numbered[number]) for number in numbers]
        existing = [depth if depth.relative_to(folder).as_posix() in names else None for depth in depths]
        unread = cls(folder, "", Camera.guess(1, 1), ())
        metadata = unread.metadata()
        with parsing(unread.file, "`fps`, `frameTimestamps`, `dw` and `dh` as numbers"):
            times = _times(metadata, numbers)
            depth_size = int(metadata.get("dw", 0)), int(metadata.get("dh", 0))  # older versions of the app write none
        camera = lambda *size: _camera(unread.file, metadata, *size) or guess_with_warning(str(folder), *size)
        frames = zip(times, (numbered[number] for number in numbers), existing, strict=True)
        return cls.listed(folder, frames, camera, depth_size=depth_size)

    @property
    def file(self) -> Path:
        return self.folder / (EXPORTED if (self.folder / EXPORTED).is_file() else METADATA)

    def metadata(self) -> Mapping[str, Any]:
        """Return the metadata; raise InputError unless they are a JSON object."""
        with parsing(self.file, "a JSON object with `K`, `fps` and `poses`"):
            return dict(json_in(self._content(self.file, MAX_TEXT), self.file))

    def holds(self, path: Path) -> bool:
        return self._entry(path).is_file()

    def stored_image(self, path: Path, min_bits: int = 8) -> ImageFile:
        return image_in(self._content(path), path, min_bits)

    def load_depth(self, path: Path) -> np.ndarray:
        """Return the depth in a file of the archive, enlarged to the images, without pixels of low confidence."""
        if path.suffix == ".exr":
            return self.enlarge_depth(read_depth(path, self.depth_format))
        shape = self.camera.height, self.camera.width
        depth = _shaped(self._unpacked(path, 4), np.float32, path, self.depth_size[::-1], shape)
        depth = metres_of_floats(depth)
        file = path.with_suffix(".conf")
        if self.holds(file):
            confidence = _shaped(self._unpacked(file, 1), np.uint8, file, depth.shape, shape)
            depth[confidence < _MIN_CONFIDENCE] = np.nan
        return self.enlarge_depth(depth)

    def ground_truth(self) -> Trajectory | None:
        """Return ARKit's poses, camera -> world, None without any; the file has OpenGL's axes."""
        poses, where = self.metadata().get("poses"), self.file
        if not (isinstance(poses, list) and poses):
            return None
        with parsing(where, "7 numbers for each of `poses`, a quaternion and a position"):
            rows = np.array(poses, np.float64).reshape(len(poses), 7)
        numbers = [int(file.image.stem) for file in self.files]
        posed = [row for row, number in enumerate(numbers) if number < len(rows)]
        found = poses_of(rows[:, 4:], rows[:, :4])[[numbers[row] for row in posed]] @ FROM_OPENGL
        return trajectory_of([self.files[row].timestamp for row in posed], found, where)

    def _content(self, path: Path, max_bytes: int = MAX_BYTES) -> bytes:
        """Return the content of a file in the folder or archive; in a folder it may have at most `max_bytes`."""
        if self.folder.is_dir():
            return content_of(path, max_bytes)
        try:
            return self._entry(path).read_bytes()
        except UNREADABLE as error:
            raise InputError(f"`{path}` cannot be read: {error}") from None

    def _entry(self, path: Path) -> Path | zipfile.Path:
        return self._root / path.relative_to(self.folder).as_posix()

    @cached_property
    def _root(self) -> Path | zipfile.Path:
        """Return the folder or the open archive, kept open since its directory takes longer to read than an image."""
        return _root(self.folder)

    def _unpacked(self, path: Path, item_bytes: int) -> bytes:
        """Return bytes decompressed from LZFSE: at most one item per pixel of the image, as a protection of memory."""
        max_bytes = item_bytes * self.camera.width * self.camera.height
        packed = self._content(path)
        try:
            content = _decoder()(packed, out=max_bytes + 1)
        except (ValueError, RuntimeError) as error:
            raise InputError(f"`{path}` cannot be unpacked (LZFSE): {error}") from None
        return bytes(content)


def _root(place: Path) -> Path | zipfile.Path:
    return place if place.is_dir() else zipfile.Path(place)


def _names(place: Path) -> set[str]:
    """Return the names of the files."""
    root = _root(place)
    names = {name for name in (METADATA, EXPORTED) if (root / name).is_file()}
    folders = (root / name for name in ("rgbd", "rgb", "depth"))
    return names | {f"{folder.name}/{file.name}" for folder in folders if folder.is_dir() for file in folder.iterdir()}


def _depth_of(image: Path) -> Path:
    exported = image.parent.name != "rgbd"
    return image.parent.parent / "depth" / f"{image.stem}.exr" if exported else image.with_suffix(".depth")


def _decoder() -> Callable[..., Any]:
    try:
        from imagecodecs import lzfse_decode
    except ImportError:
        raise InputError(f"depth (LZFSE) needs the package imagecodecs; {install_hint('phones')}") from None
    return cast(Callable[..., Any], lzfse_decode)


def _shaped(content: bytes, kind: type, path: Path, size: tuple[int, int], image: tuple[int, int]) -> np.ndarray:
    """Return an array of `size` (rows, columns); for (0, 0) the size follows from the aspect of the image."""
    each = np.dtype(kind).itemsize
    rows, columns = size
    if not all(size):
        rows = round(math.sqrt(len(content) / each * image[0] / image[1]))
        columns = round(rows * image[1] / image[0])
    if not content or rows * columns * each != len(content):
        raise InputError(
            f"`{path}` must unpack to {rows * columns * each} bytes, {columns} x {rows} pixels, got {len(content)}"
        )
    return np.frombuffer(content, kind).reshape(rows, columns)


def _times(metadata: Mapping[str, Any], numbers: list[int]) -> list[float]:
    """Return the times of the images, seconds: those of the metadata if they increase, else by the frame rate."""
    stamps = metadata.get("frameTimestamps") or ()
    times = [float(stamps[number]) for number in numbers] if len(stamps) > numbers[-1] else []
    if times and all(after > before for before, after in pairwise(times)):
        return times
    rate = float(metadata.get("fps") or FRAMES_PER_SECOND)
    return [number / rate for number in numbers]


def _camera(where: Path, metadata: Mapping[str, Any], width: int, height: int) -> Camera | None:
    """Return the camera of the metadata; None without one, or, with a warning, for another image size."""
    size = metadata.get("w"), metadata.get("h")
    if None not in size and not same_size(size, (width, height)):
        warn(f"`{where}` has a camera for {size[0]} x {size[1]} pixels; the images are {width} x {height}: not used")
        return None
    if not {"K", "perFrameIntrinsicCoeffs"} & metadata.keys():
        return None
    return camera_of_record3d(where, metadata, width, height)
