"""Base class of all sequences of image files: a list of files, read one by one, with warnings about invalid ones."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import cv2
import numpy as np
from jaxtyping import UInt8

from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.image_files import (
    MAX_DEPTH,
    MILLIMETRES,
    MIN_DEPTH,
    DepthFormat,
    ImageFile,
    path_exists,
    read_depth,
    read_image_file,
)
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, LeftOutWarning, UnusableDepthWarning, warn

MAX_TIMESTAMP = 1e11
"""Maximum timestamp, seconds (3,000 years); Unix times in nanoseconds, 1e18, are above it."""
MAX_ENLARGEMENT = 32
"""Maximum ratio of the sides of an image and of its depth; phones have 8."""
_SAMPLES = 3
"""Number of images that are read to find the common size."""
_SAME_ASPECT = 0.01
"""Maximum relative difference of the aspect ratios of images and depth."""


@dataclass(frozen=True)
class FrameFile:
    """The files of one frame. Fields: index, position in the sequence; timestamp, seconds; image; depth, if any."""

    index: int
    timestamp: float
    image: Path
    depth: Path | None = None


@dataclass(frozen=True)
class FolderSequence:
    """A sequence of image files. Subclasses (7-Scenes, TUM, plain folder) list the files and read the ground truth.

    Fields: folder; name; camera; files, in the order of time; depth_format, unit of the depth files; has_depth, False
    to ignore the depth files.
    """

    folder: Path
    name: str
    camera: Camera
    files: tuple[FrameFile, ...] = field(repr=False)
    depth_format: DepthFormat = MILLIMETRES
    has_depth: bool = False

    depth_of_fewer_pixels: ClassVar[bool] = False
    """Whether depth of a lower resolution and the same aspect as the images is enlarged to them."""

    @classmethod
    def listed(
        cls,
        folder: Path,
        frames: Iterable[tuple[float, Path, Path | None]],
        camera: Callable[[int, int], Camera],
        coding: DepthFormat = MILLIMETRES,
        **fields: Any,
    ) -> Self:
        """Make a sequence of frames (time, image, depth), in order, with warnings about missing and invalid depth.

        camera: returns the camera for the width and height of the images. coding: unit of the depth files. fields:
        further fields of the class.
        """
        files = tuple(FrameFile(index, *frame) for index, frame in enumerate(frames))
        if not files:
            raise InputError(f"`{folder}` has no images of a {cls.__name__}; `vggtgeo data list` shows its layout")
        for file in files:
            if not abs(file.timestamp) <= MAX_TIMESTAMP:
                name = file.image.name
                raise InputError(f"`{folder}`: the time of `{name}` must be in seconds, got {file.timestamp:g}")
        without = sum(file.depth is None for file in files)
        if 0 < without < len(files):
            warn(f"`{folder}`: {without} of {len(files)} images have no depth")
        # The camera needs the size of the images, and the check of the depth needs the camera.
        sequence = cls(folder, folder.resolve().name, Camera.guess(1, 1), files, coding, without < len(files), **fields)
        sequence = replace(sequence, camera=camera(*sequence.common_size()))
        return replace(sequence, has_depth=sequence.depth_is_usable())

    def __len__(self) -> int:
        return len(self.files)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`. Images of another size than the camera are skipped with a warning."""
        check_selection(self.name, len(self), start, end, stride)
        return self._read_all(self.files[start:end:stride])

    def ground_truth(self) -> Trajectory | None:
        """Return the poses of `groundtruth.txt` (TUM format), None without it; subclasses may override it."""
        file = self.folder / "groundtruth.txt"
        return Trajectory.load_tum(file) if file.exists() else None

    @property
    def truth_in_metres(self) -> bool:
        """Return whether lengths of `ground_truth` are metres."""
        return True

    def holds(self, path: Path) -> bool:
        """Return whether a file of `files` exists."""
        return path_exists(path)

    def stored_image(self, path: Path, min_bits: int = 8) -> ImageFile:
        """Return the image in a file, see `read_image_file`; sequences in archives override it."""
        return read_image_file(path, min_bits)

    def load_image(self, path: Path, min_bits: int = 8) -> ImageFile:
        """Return the image with the sequence's camera; sequences that resample their images override it."""
        return self.stored_image(path, min_bits)

    def load_depth(self, path: Path) -> np.ndarray:
        """Return the depth in a file, float32 [H, W], metres, NaN for none, in the colour camera."""
        depth = read_depth(path, self.depth_format)
        return self.enlarge_depth(depth) if self.depth_of_fewer_pixels else depth

    def enlarge_depth(self, depth: np.ndarray) -> np.ndarray:
        """Enlarge depth of a lower resolution to the images, float32 [height, width], without interpolation.

        Depth of another aspect ratio, or of very few pixels, shows another view and is returned unchanged.
        """
        (rows, columns), width, height = depth.shape, self.camera.width, self.camera.height
        same_view = abs(columns * height / width - rows) < max(1.0, _SAME_ASPECT * rows)
        if not same_view or not columns < width <= columns * MAX_ENLARGEMENT:
            return depth
        return np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), np.float32)

    def common_size(self) -> tuple[int, int]:
        """Return the most common width and height of a few images; raise InputError if none can be read."""
        shapes: Counter[tuple[int, ...]] = Counter()
        reason = ""
        for file in _ends_and_middle_first(self.files):
            try:
                shapes[self.stored_image(file.image).image.shape] += 1
            except InputError as error:
                reason = reason or str(error)
            if shapes.total() == _SAMPLES:
                break
        if not shapes:
            raise InputError(f"none of the {len(self)} images of `{self.folder}` can be read; first error: {reason}")
        height, width, _ = shapes.most_common(1)[0][0]
        return width, height

    def depth_is_usable(self) -> bool:
        """Return whether a depth file has a valid pixel, with an UnusableDepthWarning if none has.

        Reads the first, middle and last file, then the others until one has a valid pixel. Raises InputError if the
        depth has another size than the images.
        """
        depths = [file.depth for file in _ends_and_middle_first(self.files) if file.depth is not None]
        reason = ""
        for path in depths:
            try:
                depth = self.load_depth(path)
            except InputError as error:
                reason = reason or f" ({error})"
                continue
            if depth.shape != (self.camera.height, self.camera.width):
                size = self._depth_size_message(path, depth)
                raise InputError(f"{size}: register the depth to the images, or ignore it with --rgb-only")
            if np.isfinite(depth).any():
                return True
        if depths:
            warn(
                f"`{self.folder}`: none of the {len(depths)} depth images has a valid pixel{reason}, {MIN_DEPTH:g} to "
                f"{MAX_DEPTH:g} m (`--depth-scale` sets the units per metre); reading the images only",
                UnusableDepthWarning,
            )
        return False

    def _read_all(self, files: Sequence[FrameFile]) -> Iterator[Frame]:
        images, empty = ImageChecks(self.camera), []
        for file in files:
            image = images.checked(file.image, self.load_image)
            if image is None:
                continue
            depth = self._read_depth(file) if self.has_depth else None
            if depth is not None and not np.isfinite(depth).any():
                empty.append(file.depth)
            if self.has_depth and depth is None:
                depth = np.full((self.camera.height, self.camera.width), np.nan, np.float32)
            yield Frame(file.index, file.timestamp, image, depth, file.image.name)
        if empty:
            warn(f"`{self.name}`: {len(empty)} of {len(files)} depth images have no valid pixel, first `{empty[0]}`")

    def _read_depth(self, file: FrameFile) -> np.ndarray | None:
        """Read the depth of a frame; None if it has none, or, with a warning, if it is invalid."""
        if file.depth is None:
            return None
        try:
            depth = self.load_depth(file.depth)
        except InputError as error:
            warn(f"{error}; the frame is used without depth")
            return None
        if depth.shape != (self.camera.height, self.camera.width):
            warn(f"{self._depth_size_message(file.depth, depth)}; used without depth")
            return None
        return depth

    def _depth_size_message(self, path: Path, depth: np.ndarray) -> str:
        size = f"{self.camera.width} x {self.camera.height}"
        return f"`{path}` is {depth.shape[1]} x {depth.shape[0]} pixels; the colour images are {size}"


class ImageChecks:
    """Reads the images of a sequence in order, and warns of invalid ones and of an EXIF orientation."""

    def __init__(self, camera: Camera) -> None:
        self._size = camera.width, camera.height
        self._bits, self._turned = 8, False

    def checked(self, place: Path, load: Callable[[Path, int], ImageFile]) -> UInt8[np.ndarray, "h w 3"] | None:
        """Return an image; None, after a warning, if it cannot be read or has another size than the camera's images.

        load: returns the image at `place`, read with at least the given number of bits.
        """
        try:
            read = load(place, self._bits)
        except InputError as error:
            warn(f"{error}; the frame is skipped", LeftOutWarning)
            return None
        height, width = read.image.shape[:2]
        if (width, height) != self._size:
            sizes = f"{width} x {height} pixels; the sequence's images are {self._size[0]} x {self._size[1]}"
            warn(f"`{place}` is {sizes}: the frame is skipped", LeftOutWarning)
            return None
        self._bits = max(self._bits, read.bits)
        if read.orientation != 1 and not self._turned:
            self._turned = True
            warn(
                f"`{place}` has the EXIF orientation {read.orientation}, which is not applied: intrinsics and depth "
                "must be those of the stored images"
            )
        return read.image


def existing(path: Path) -> Path | None:
    """Return a path if it is a file, else None."""
    return path if path.is_file() else None


def _ends_and_middle_first(files: Sequence[FrameFile]) -> list[FrameFile]:
    """Return all files, with the first, middle and last one in front."""
    first = dict.fromkeys((0, len(files) // 2, len(files) - 1))
    order = [*first, *(row for row in range(len(files)) if row not in first)]
    return [files[row] for row in order] if files else []
