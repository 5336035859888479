"""Frames of any iterable: a list, a generator, a live camera."""

from __future__ import annotations

import itertools
import sys
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vggtgeo.datasets.depth_files import MAX_DEPTH, MIN_DEPTH
from vggtgeo.datasets.frame import Frame, check_depth, check_selection, described
from vggtgeo.datasets.image_files import MAX_PIXELS
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError, InputWarning


@dataclass(frozen=True, eq=False)
class FrameStream:
    """Frames of one camera, read once."""

    camera: Camera
    has_depth: bool
    source: Iterator[Frame]

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Return every `stride`-th frame from `start` to before `end`."""
        check_selection("frames", sys.maxsize, start, end, stride)
        return itertools.islice(self.source, start, end, stride)


def frame_stream(frames: Iterable[Any], camera: Camera | None = None, rate: float = 30.0) -> FrameStream:
    """Return frames of any iterable, which is read one frame ahead.

    Args:
        frames: of `Frame`; or images, uint8 [H, W, 3] RGB; or pairs of an image and depth, float [H, W] metres with NaN
            for none. They are copied: a camera may reuse one array.
        camera: of all frames; None: a guess from the size of the first image, and intrinsics are estimated.
        rate: frames a second, for images without a time of their own.

    Raises:
        InputError: there is no frame, or one has another type.

    """
    if not isinstance(frames, Iterable):
        raise InputError(f"`frames` is {described(frames)}; give a folder, a video file, or images one after another")
    counted = (_frame(item, index, rate) for index, item in enumerate(frames))
    first = next(counted, None)
    if first is None:
        raise InputError("`frames` is empty; give at least one frame")
    height, width = first.image.shape[:2]
    source = _of_one_kind(first, counted)
    return FrameStream(camera or Camera.guess(width, height), first.depth is not None, source)


def _of_one_kind(first: Frame, others: Iterator[Frame]) -> Iterator[Frame]:
    """Yield all frames; warn of depth that later frames alone have, and of depth in another unit."""
    last, warned = first, first.depth is not None
    _warn_of_unit(first)
    yield first
    for frame in others:
        if frame.index <= last.index:
            raise InputError(
                f"`{frame.name}` has the index {frame.index} after {last.index}; number the frames from 0 on, as "
                "`enumerate` does"
            )
        if frame.depth is not None and not warned:
            warnings.warn(
                f"`{frame.name}` has depth, and `{first.name}` had none: depth is used where the first frame has it, "
                "all NaN if need be; reading the images only",
                InputWarning,
                stacklevel=2,
            )
            warned = True
        yield frame
        last = frame


def _warn_of_unit(frame: Frame) -> None:
    """Warn of depth without a value in range; all NaN is valid."""
    depth = frame.depth
    if not isinstance(depth, np.ndarray) or depth.dtype.kind != "f" or np.isnan(depth).all():
        return
    if not ((depth >= MIN_DEPTH) & (depth <= MAX_DEPTH)).any():
        warnings.warn(
            f"the depth of `{frame.name}` goes from {np.nanmin(depth):g} to {np.nanmax(depth):g}, and none of it is "
            f"from {MIN_DEPTH:g} to {MAX_DEPTH:g} m: are these metres (millimetres: divide by 1000.0)? It is not used",
            InputWarning,
            stacklevel=3,
        )


def _frame(item: Any, index: int, rate: float) -> Frame:
    if isinstance(item, Frame):
        given: Any = item.image
        if not isinstance(given, np.ndarray) or given.ndim != 3:
            raise InputError(f"`frames[{index}]` has an image {described(given)}; it must be uint8 [H, W, 3], RGB")
        return copied(item)
    image, depth = item if isinstance(item, tuple) and len(item) == 2 else (item, None)
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise InputError(
            f"`frames[{index}]` is {described(image)}; it must be a `Frame`, uint8 [H, W, 3], or (image, depth)"
        )
    if depth is not None:
        check_depth(f"the depth of `frames[{index}]`", depth, image)
        depth = depth.astype(np.float32)
    return Frame(index, index / rate, _own(f"frame {index}", image), depth, f"frame {index}")


def copied(frame: Frame) -> Frame:
    """Return the frame with copies of its arrays; raise InputError if they are too large."""
    return replace(frame, image=_own(frame.name, frame.image), depth=_own(frame.name, frame.depth))


def _own(name: str, given: Any) -> Any:
    """Return a copy of an image or of depth; raise InputError if it is too large."""
    if isinstance(given, np.ndarray) and given[..., :1].size > MAX_PIXELS:
        raise InputError(f"`{name}` has the shape {given.shape}, more than {MAX_PIXELS // 10**6} million pixels")
    return given.copy() if isinstance(given, np.ndarray) else given
