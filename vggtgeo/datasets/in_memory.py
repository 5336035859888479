"""Frames that come from anywhere: a list, a generator, a camera that is running."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class FrameStream:
    """Frames of one camera, read once, as they come."""

    camera: Camera
    has_depth: bool
    source: Iterator[Frame]

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Every `stride`-th frame from `start` to before `end`."""
        return itertools.islice(self.source, start, end, stride)


def frame_stream(frames: Iterable[Any], camera: Camera | None = None, rate: float = 30.0) -> FrameStream:
    """Frames from any iterable, which is asked for one frame more than is needed at once.

    Args:
        frames: of `Frame`; or images, uint8 [H, W, 3] RGB; or pairs of an image and depth, float [H, W] metres with NaN
            for none.
        camera: of all frames; None guesses from the size of the first image (then the intrinsics are estimated).
        rate: frames a second, for images without a time of their own.

    Raises:
        InputError: there is no frame, or one is nothing of these.

    """
    counted = (_frame(item, index, rate) for index, item in enumerate(frames))
    first = next(counted, None)
    if first is None:
        raise InputError("`frames` is empty; give at least one frame")
    height, width = first.image.shape[:2]
    source = itertools.chain([first], counted)
    return FrameStream(camera or Camera.guess(width, height), first.depth is not None, source)


def _frame(item: Any, index: int, rate: float) -> Frame:
    if isinstance(item, Frame):
        return item
    image, depth = item if isinstance(item, tuple) and len(item) == 2 else (item, None)
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        found = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise InputError(f"`frames[{index}]` is {found}; it must be a `Frame`, uint8 [H, W, 3], or (image, depth)")
    if depth is not None:
        depth = np.asarray(depth, np.float32)
        if depth.shape != image.shape[:2]:
            raise InputError(
                f"`frames[{index}]` has depth {depth.shape} for an image {image.shape[:2]}; make them equal"
            )
    return Frame(index, index / rate, image, depth, f"frame {index}")
