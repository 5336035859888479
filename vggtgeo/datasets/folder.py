"""Base of all sequences of image files: a list of files, read one by one, with warnings about invalid ones."""

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.image_files import (
    MILLIMETRES,
    DepthFormat,
    ImageFile,
    floats_out_of_range,
    is_there,
    orientation_message,
    read_depth,
    read_image,
    read_image_file,
)
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning, NoteWarning, UnusableDepthWarning

LATEST = 1e11
"""Seconds of a time stamp at most, 3,000 years: Unix times in nanoseconds are 1e18."""
_SAMPLES = 3
_NAMED_EMPTY_DEPTHS = 3


@dataclass(frozen=True)
class FrameFile:
    """The files of one frame. Fields: index, position in the sequence; timestamp, seconds; image; depth, if any."""

    index: int
    timestamp: float
    image: Path
    depth: Path | None = None


@dataclass(frozen=True)
class FolderSequence:
    """A sequence of image files; the layouts (7-Scenes, TUM, plain folder) list the files and know the truth.

    Fields: folder; name; camera; files, in the order of time; depth_format, how the depth files code metres;
    has_depth, False to leave the depth files alone.
    """

    folder: Path
    name: str
    camera: Camera
    files: tuple[FrameFile, ...] = field(repr=False)
    depth_format: DepthFormat = MILLIMETRES
    has_depth: bool = False

    depth_of_fewer_pixels: ClassVar[bool] = False
    """Whether depth of fewer pixels and the same aspect as the images is enlarged to them."""

    def __post_init__(self) -> None:
        for file in self.files:
            if not math.isfinite(file.timestamp):
                raise InputError(f"`{self.folder}`: `{file.image}` has the time {file.timestamp}; expected seconds")
            if abs(file.timestamp) > LATEST:
                raise InputError(
                    f"`{self.folder}`: `{file.image}` has the time {file.timestamp:g}, which is beyond all clocks; it "
                    "must be in seconds"
                )
            if file.image == file.depth:
                raise InputError(
                    f"`{self.folder}`: `{file.image}` is listed as an image and as depth; expected two files"
                )

    @classmethod
    def listed(
        cls,
        folder: Path,
        frames: Iterable[tuple[float, Path, Path | None]],
        camera: Callable[[int, int], Camera],
        coding: DepthFormat = MILLIMETRES,
        *,
        as_images: bool = True,
        **fields: Any,
    ) -> Self:
        """Make a sequence of frames (time, image, depth), with warnings about missing and invalid depth.

        Args:
            folder: where the frames are.
            frames: in the order of the sequence.
            camera: returns the camera for the width and height of the images.
            coding: unit of the depth files.
            as_images: whether depth files must have the size of the images; otherwise `load_depth` checks them.
            fields: further fields of the class.

        """
        files = tuple(FrameFile(index, *frame) for index, frame in enumerate(frames))
        warn_of_no_depth(folder, files)
        width, height = common_size(str(folder), files)
        has_depth = any(file.depth is not None for file in files)
        whole = cls(folder, folder.resolve().name, camera(width, height), files, coding, has_depth, **fields)
        if as_images:
            usable = depth_is_usable(str(folder), files, coding, width, height, cls.depth_of_fewer_pixels)
        else:
            usable = has_depth and whole.depth_can_be_read()
        return replace(whole, has_depth=usable)

    def __len__(self) -> int:
        return len(self.files)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`. Images of another size than the camera are skipped with a warning."""
        check_selection(self.name, len(self), start, end, stride)
        return self._read_all(self.files[start:end:stride])

    def ground_truth(self) -> Trajectory | None:
        """Return None; layouts with ground truth override it."""
        return None

    @property
    def truth_in_metres(self) -> bool:
        """Return whether lengths of `ground_truth` are metres."""
        return True

    def holds(self, path: Path) -> bool:
        """Return whether a file of `files` exists."""
        return is_there(path)

    def load_image(self, path: Path, min_bits: int = 8) -> ImageFile:
        """Return the image in a file, see `read_image_file`; layouts whose images must be changed override it."""
        return read_image_file(path, min_bits)

    def load_depth(self, path: Path) -> np.ndarray:
        """Return the depth in a file, float32 [H, W], metres, NaN for none, in the colour camera."""
        depth = read_depth(path, self.depth_format)
        size = self.camera.width, self.camera.height
        return (
            enlarged(depth, size, path) if self.depth_of_fewer_pixels and _is_of_fewer_pixels(depth, *size) else depth
        )

    def depth_can_be_read(self) -> bool:
        """Return whether depth of the first, middle or last image with depth can be read; else warn."""
        depths = [file.depth for file in self.files if file.depth is not None]
        reason = ""
        for depth in (depths[0], depths[len(depths) // 2], depths[-1]):
            try:
                self.load_depth(depth)
            except InputError as error:
                reason = reason or str(error)
            else:
                return True
        text = f"{reason}; reading the images only, without their {len(depths)} depth images"
        warnings.warn(text, InputWarning, stacklevel=4)
        return False

    def _read_all(self, files: Sequence[FrameFile]) -> Iterator[Frame]:
        empty = 0
        bits = 8
        turned = False
        for number, file in enumerate(files):
            if not is_there(file.image) and not self.folder.exists():
                left = len(files) - number
                text = (
                    f"`{self.folder}` is no longer there: it was moved or deleted while it was read; the last "
                    f"{left} of {len(files)} frames are left out"
                )
                warnings.warn(LeftOutWarning(text, left), stacklevel=3)
                break
            read = self._read_image(file, bits)
            if read is None:
                continue
            if read.bits > bits and (bits > 8 or read.bits < 16):
                _warn(f"`{file.image}` has values of {read.bits} bits: taken for an image of so many from here on")
            bits = max(bits, read.bits)
            if read.orientation != 1 and not turned:
                turned = True
                _warn(orientation_message(file.image, read.orientation))
            image = read.image
            depth = self._read_depth(file) if self.has_depth else None
            if file.depth is not None and depth is not None and not np.isfinite(depth).any():
                empty += 1
                if empty <= _NAMED_EMPTY_DEPTHS:
                    _warn(f"`{file.depth}` gives no valid depth; the frame is used without")
            if self.has_depth and depth is None:
                depth = np.full((self.camera.height, self.camera.width), np.nan, np.float32)
            yield Frame(file.index, file.timestamp, image, depth, file.image.name)
        if empty > _NAMED_EMPTY_DEPTHS:
            _warn(f"`{self.name}`: {empty} of {len(files)} depth images gave no valid depth")

    def _read_image(self, file: FrameFile, bits: int) -> ImageFile | None:
        try:
            read = self.load_image(file.image, bits)
        except InputError as error:
            _warn(f"{error}; the frame is skipped", LeftOutWarning)
            return None
        height, width = read.image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            _warn(
                f"`{file.image}` is {width} x {height} pixels; the sequence's images are "
                f"{self.camera.width} x {self.camera.height}: the frame is skipped",
                LeftOutWarning,
            )
            return None
        return read

    def _read_depth(self, file: FrameFile) -> np.ndarray | None:
        """None if there is no depth, or, with a warning, if it cannot be used."""
        if file.depth is None:
            return None
        try:
            depth = self.load_depth(file.depth)
        except InputError as error:
            _warn(f"{error}; the frame is used without depth")
            return None
        if depth.shape != (self.camera.height, self.camera.width):
            _warn(_other_size(file.depth, depth, self.camera.width, self.camera.height) + "; used without depth")
            return None
        return depth


def common_size(
    name: str, files: Sequence[FrameFile], read: Callable[[Path], np.ndarray] = read_image
) -> tuple[int, int]:
    """Return width and height of most of a few readable images; raise InputError if none can be read."""
    sizes: list[tuple[int, int]] = []
    reason = ""
    for file in _spread(files):
        try:
            height, width = read(file.image).shape[:2]
        except InputError as error:
            reason = reason or str(error)
            continue
        sizes.append((width, height))
        if len(sizes) == _SAMPLES:
            break
    if not sizes:
        raise InputError(f"none of the {len(files)} images of `{name}` can be read; the first: {reason}")
    return Counter(sizes).most_common(1)[0][0]


MIN_MEDIAN_DEPTH = 0.01
"""Metres: below the range of all depth cameras."""
_SAME_SHAPE = 0.01
MAX_ENLARGEMENT = 32
"""Pixels of an image to one of its depth, along a side at most; phones have 8."""


def depth_is_usable(
    name: str, files: Sequence[FrameFile], coding: DepthFormat, width: int, height: int, of_fewer_pixels: bool = False
) -> bool:
    """Return whether the sequence has depth to work with: files, of the images' size, with a valid pixel in one of
    them.

    Looks at the first, middle and last file, and at the others only while no valid pixel has been seen.
    InputError where the depth has another size than the images; an UnusableDepthWarning where no pixel of any file
    is valid. of_fewer_pixels: depth of fewer pixels will do, if it has the shape of the images; an InputWarning says
    so.
    """
    with_depth = [file for file in files if file.depth is not None]
    reason = ""
    for file in _spread(with_depth):
        assert file.depth is not None
        try:
            depth = read_depth(file.depth, coding)
        except InputError as error:
            reason = reason or f" ({error})"
            continue
        of_fewer = of_fewer_pixels and _is_of_fewer_pixels(depth, width, height)
        if depth.shape != (height, width) and not of_fewer:
            raise InputError(
                _other_size(file.depth, depth, width, height) + ": register the depth to the images, or leave it out "
                "with --rgb-only"
            )
        if np.isfinite(depth).any():
            if (middle := float(np.nanmedian(depth))) < MIN_MEDIAN_DEPTH:
                _warn(
                    f"`{file.depth}`: half of its depths are below {middle:.2g} m: is its unit another? "
                    "`--depth-scale` says how many there are in a metre: 1000 are millimetres"
                )
            if of_fewer:
                _warn(
                    _other_size(file.depth, depth, width, height) + ": taken for the same view, and enlarged to them",
                    NoteWarning,
                )
            return True
    if with_depth:
        gone = not any(file.depth is not None and is_there(file.depth) for file in with_depth)
        reason = reason if gone or reason else floats_out_of_range(next(f.depth for f in with_depth if f.depth))
        what = f"is there: `{with_depth[0].depth}`, ..." if gone else f"has a valid pixel{reason}"
        text = f"`{name}`: none of the {len(with_depth)} depth images {what}; reading the images only"
        _warn(text, InputWarning if gone else UnusableDepthWarning)
    return False


def existing(path: Path) -> Path | None:
    """Return a path if it is a file, else None."""
    return path if path.is_file() else None


def warn_of_no_depth(folder: Path, files: Sequence[FrameFile]) -> None:
    """Warn of images without depth where others have one, as after an incomplete copy."""
    alone = sum(file.depth is None for file in files)
    if 0 < alone < len(files):
        _warn(f"`{folder}`: {alone} of {len(files)} images have no depth")


def enlarged(depth: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    """Return depth of another number of pixels in the same view, float32 [height, width]: each pixel takes the nearest.

    Raises:
        InputError: it has another shape than the images, so that it is of another view, or hardly any pixels.

    """
    (rows, columns), (width, height) = depth.shape, size
    if (rows, columns) == (height, width):
        return depth
    if not _has_the_shape(depth, width, height) or columns > width * MAX_ENLARGEMENT:
        raise InputError(
            _other_size(path, depth, width, height) + ": no such size of the same view; register the depth to the "
            "images, or leave it out with --rgb-only"
        )
    return np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)


def _is_of_fewer_pixels(depth: np.ndarray, width: int, height: int) -> bool:
    """Return whether depth [h, w] has the aspect of images of this size but fewer pixels, as a phone's LiDAR."""
    return depth.shape[1] < width and _has_the_shape(depth, width, height)


def _has_the_shape(depth: np.ndarray, width: int, height: int) -> bool:
    """Return whether depth [h, w] has the shape of images of this size, to a row or a hundredth, and not hardly any
    pixels.
    """
    rows, columns = depth.shape
    alike = abs(columns * height / width - rows) < max(1.0, _SAME_SHAPE * rows)
    return alike and columns * MAX_ENLARGEMENT >= width


def _spread(files: Sequence[FrameFile]) -> list[FrameFile]:
    first = dict.fromkeys((0, len(files) // 2, len(files) - 1))
    order = [*first, *(row for row in range(len(files)) if row not in first)]
    return [files[row] for row in order] if files else []


def _other_size(path: Path, depth: np.ndarray, width: int, height: int) -> str:
    return f"`{path}` is {depth.shape[1]} x {depth.shape[0]} pixels; the colour images are {width} x {height}"


def _warn(message: str, category: type[InputWarning] = InputWarning) -> None:
    warnings.warn(message, category, stacklevel=4)
