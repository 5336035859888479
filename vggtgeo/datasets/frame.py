"""Interface of all readers: frames, camera, and ground truth if there is one."""

import numbers
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import MAX_TIME, Trajectory
from vggtgeo.io.argument_checks import check_whole
from vggtgeo.io.errors import InputError

MAX_DELAY = 0.02
"""Maximum seconds between an image and its depth."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a sequence, with the distortion of its lens.

    Fields:
        index: position in the whole sequence, from 0, skipped frames included.
        timestamp: seconds.
        image: uint8 [H, W, 3], RGB.
        depth: float32 [H, W], z in metres, NaN = none; None for a sequence without depth.
        name: the file's name, for messages.

    Example:
        >>> import numpy as np, vggtgeo as vg
        >>> vg.data.Frame(0, 0.0, np.zeros((240, 320, 3), np.uint8), None, "black")
        Frame(0, 0.000 s, 320 x 240, no depth, 'black')

    """

    index: int
    timestamp: float
    image: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"] | None
    name: str

    def __repr__(self) -> str:
        size = " x ".join(map(str, np.shape(self.image)[1::-1])) or "no image"
        depth = "no depth" if self.depth is None else "depth"
        return f"Frame({self.index}, {self.timestamp:.3f} s, {size}, {depth}, {self.name!r})"


@runtime_checkable
class Sequence(Protocol):
    """Frames with one camera. Ground truth is for evaluation only: estimators must not use it."""

    @property
    def name(self) -> str:
        """Return the name, for titles and messages."""

    @property
    def camera(self) -> Camera:
        """Return the camera of all frames; `camera.known` is False if its intrinsics are a guess."""

    @property
    def has_depth(self) -> bool:
        """Return whether frames have depth: every frame then has an array, all NaN if its file is invalid."""

    def __len__(self) -> int:
        """Return the number of frames, unreadable ones included; of a video, the container's estimate."""

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Return the frames at positions start, start + stride, ... below end, each read when requested.

        Warns of files that cannot be read, which are skipped; raises InputError for an invalid or empty selection.
        """

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses, camera -> world; None without ground truth."""


def check_selection(name: str, count: int, start: int, end: int | None, stride: int) -> None:
    """Raise InputError unless `start`, `end`, `stride` select at least one of `count` frames of sequence `name`."""
    check_range(start, end, stride)
    if start >= count:
        raise InputError(f"`start` must be at most {count - 1}, got {start}: `{name}` has {count} frames")


def check_range(start: int, end: int | None, stride: int) -> None:
    """Raise InputError unless `start`, `end`, `stride` are a valid range of frames."""
    check_whole("start", start)
    check_whole("stride", stride, 1)
    if end is not None:
        check_whole("end", end)
        if end <= start:
            raise InputError(f"`end` must be above `start`, got start {start} and end {end}")


def check_frame(frame: Frame, camera: Camera) -> None:
    """Raise InputError for a frame with an invalid image, depth or time, or another size than the camera's images."""
    time: Any = frame.timestamp  # may have any type: a user makes frames, too
    check_image(f"the image of `{frame.name}`", frame.image)
    if not isinstance(time, numbers.Real) or not -MAX_TIME <= frame.timestamp <= MAX_TIME:
        raise InputError(f"the time of `{frame.name}` must be a number of seconds, got {time!r:.60}")
    if frame.depth is not None:
        check_depth(f"the depth of `{frame.name}`", frame.depth, frame.image)
    height, width = frame.image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"`{frame.name}` is {width} x {height} pixels; the camera's images are {camera.width} x {camera.height}: "
            "all frames of a run must have one size"
        )


def check_image(name: str, image: Any) -> None:
    """Raise InputError unless an image is an array uint8 [H, W, 3]."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"{name} must be uint8 [H, W, 3], RGB, got {type_and_shape(image)}")


def check_depth(name: str, depth: Any, image: np.ndarray) -> None:
    """Raise InputError unless depth is an array of metres with the size of its image."""
    if isinstance(depth, np.ma.MaskedArray) or not isinstance(depth, np.ndarray) or depth.dtype.kind != "f":
        raise InputError(
            f"{name} must be a float array, got {type_and_shape(depth)}: give metres (millimetres: divide by 1000.0), "
            "with NaN for none (a masked array: `depth.filled(np.nan)`)"
        )
    if depth.shape != image.shape[:2]:
        raise InputError(f"{name} must have the shape of its image, {image.shape[:2]}, got {depth.shape}")


def type_and_shape(given: Any) -> str:
    """Return the type of a value, and of an array the shape, for errors."""
    kind = f"`{type(given).__name__}`"
    return f"{kind}, {given.dtype} {given.shape}" if isinstance(given, np.ndarray) else kind


class NearestInTime:
    """Finds in a stream of (time, value) the value nearest to each of a series of rising times: depth for images."""

    def __init__(self, entries: Iterator[tuple[float, Any]]) -> None:
        self._entries = entries
        self._near: list[tuple[float, Any]] = []

    def at(self, time: float) -> Any | None:
        """Return the value nearest to a time, seconds; None if none is within `MAX_DELAY`."""
        self._near = [entry for entry in self._near if entry[0] >= time - MAX_DELAY]
        while not self._near or self._near[-1][0] <= time + MAX_DELAY:
            entry = next(self._entries, None)
            if entry is None:
                break
            if entry[0] >= time - MAX_DELAY:
                self._near.append(entry)
        near = [entry for entry in self._near if abs(entry[0] - time) <= MAX_DELAY]
        return min(near, key=lambda entry: abs(entry[0] - time))[1] if near else None
