"""Views of a sequence with other intrinsics, without depth or ground truth, or with smaller images; frame streams.

Large images are reduced because pixel noise and search radii of the pipeline are constants in pixels, measured on
images of 540 x 360 to 752 x 480. In images of phones, 1920 x 1080 and more, a corner is blurred over several pixels.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, overload

import cv2
import numpy as np

from vggtgeo.datasets.bags import RosBag
from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.frame import (
    Frame,
    Sequence,
    check_depth,
    check_frame,
    check_image,
    check_selection,
    type_and_shape,
)
from vggtgeo.datasets.image_files import MAX_DEPTH, MIN_DEPTH
from vggtgeo.datasets.images import FRAMES_PER_SECOND, ImageFolder, RgbdFolders
from vggtgeo.datasets.intrinsics import check_plausible
from vggtgeo.datasets.nerfstudio import Nerfstudio
from vggtgeo.datasets.video import VideoFile
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_positive, check_within
from vggtgeo.io.errors import InputError, warn

MIN_UNITS, MAX_UNITS = 1e-3, 1e6
"""Valid range of the units per metre of depth files."""


@dataclass(frozen=True)
class SequenceView:
    """`source` with another camera, with or without depth and ground truth."""

    source: Sequence
    camera: Camera
    has_depth: bool
    has_truth: bool = True

    @property
    def name(self) -> str:
        """Return the name of the source."""
        return self.source.name

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Return frames as `Sequence.frames`. Frames of a user's class are copied: it may reuse arrays that the map
        keeps.
        """
        frames = self.source.frames(start, end, stride)
        frames = frames if self.has_depth else (replace(frame, depth=None) for frame in frames)
        return frames if type(self.source).__module__.startswith("vggtgeo.") else map(copied, frames)

    def ground_truth(self) -> Trajectory | None:
        """Return the ground truth of the source, unless it is hidden."""
        return self.source.ground_truth() if self.has_truth else None


def with_intrinsics(sequence: Sequence, intrinsics: tuple[float, float, float, float]) -> Sequence:
    """Return the sequence with known intrinsics (pixels), replacing those of its folder."""
    camera = Camera(intrinsics, sequence.camera.width, sequence.camera.height)
    check_plausible("`intrinsics`", camera)
    source = replace(sequence, camera=camera) if isinstance(sequence, RosBag) else sequence  # depth is registered to it
    return SequenceView(source, camera, sequence.has_depth)


def with_rate(sequence: Sequence, rate: float) -> Sequence:
    """Return the sequence with `rate` frames a second, replacing assumed times or those of a video.

    Raises:
        InputError: `rate` is not positive, or the frames of the sequence already have times.

    """
    check_positive("rate", rate, "frames a second")
    if isinstance(sequence, VideoFile):
        return replace(sequence, given_rate=rate)
    if isinstance(sequence, ImageFolder | Nerfstudio | RgbdFolders):
        return replace(sequence, files=tuple(replace(file, timestamp=file.index / rate) for file in sequence.files))
    raise InputError(
        f"`rate` must be omitted for a sequence with recorded times, got {rate:g} for `{sequence.name}`: "
        "it is for videos and folders of images"
    )


def with_depth_scale(sequence: Sequence, units_per_metre: float) -> Sequence:
    """Return the sequence with another unit of its depth files: 1000 per metre for millimetres, 5000 for TUM RGB-D.

    Raises:
        InputError: the scale is implausible, or the sequence has no such depth files.

    """
    check_within("units_per_metre", units_per_metre, MIN_UNITS, MAX_UNITS, " (1000: millimetres, 5000: TUM RGB-D)")
    if (
        not isinstance(sequence, FolderSequence)
        or type(sequence).load_depth is not FolderSequence.load_depth
        or not any(file.depth for file in sequence.files)
    ):
        raise InputError(f"`{sequence.name}` has no depth files whose unit can be set")
    coding = replace(sequence.depth_format, units_per_metre=units_per_metre, floats_per_metre=units_per_metre)
    scaled = replace(sequence, depth_format=coding)
    # Floats in millimetres were invalid as metres, so the depth may be usable only now.
    return replace(scaled, has_depth=sequence.has_depth or scaled.depth_is_usable())


def without_depth(sequence: Sequence) -> Sequence:
    """Return the sequence without depth; depth files are not decoded."""
    known = isinstance(sequence, FolderSequence | RosBag | VideoFile)
    source = replace(sequence, has_depth=False) if known else sequence  # type: ignore[type-var]
    return SequenceView(source, sequence.camera, has_depth=False)


class ReducedSequence(SequenceView):
    """`source` with smaller images and depth; `camera` is that of the reduced images."""

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        return _reduced_frames(self.source.frames(start, end, stride), self.source.camera, self.camera)


@overload
def reduced(source: Sequence, max_pixels: int) -> Sequence: ...


@overload
def reduced(source: FrameStream, max_pixels: int) -> FrameStream: ...


def reduced(source: Sequence | FrameStream, max_pixels: int) -> Sequence | FrameStream:
    """Return frames and camera reduced to about `max_pixels` pixels; the source itself if it is smaller, or for 0."""
    camera = reduced_camera(source.camera, max_pixels)
    if camera == source.camera:
        return source
    if isinstance(source, FrameStream):
        return replace(source, camera=camera, source=_reduced_frames(source.source, source.camera, camera))
    return ReducedSequence(source, camera, source.has_depth)


def reduced_camera(camera: Camera, max_pixels: int) -> Camera:
    """Return the camera of images reduced to about `max_pixels` pixels; 0: unchanged."""
    factor = math.sqrt(max_pixels / (camera.width * camera.height))
    if factor >= 1 or not max_pixels:
        return camera
    return camera.resized(max(round(factor * camera.width), 1), max(round(factor * camera.height), 1))


def _reduced_frames(frames: Iterator[Frame], camera: Camera, smaller: Camera) -> Iterator[Frame]:
    size = smaller.width, smaller.height
    for frame in frames:
        check_frame(frame, camera)
        image = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)
        depth = frame.depth
        if depth is not None:  # no average: at an edge it would lie between the two surfaces
            depth = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
        yield replace(frame, image=image, depth=depth)


@dataclass(frozen=True, eq=False)
class FrameStream:
    """Frames of one camera that can be read only once."""

    camera: Camera
    has_depth: bool
    source: Iterator[Frame]

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Return every `stride`-th frame from `start` to before `end`."""
        check_selection("frames", sys.maxsize, start, end, stride)
        return itertools.islice(self.source, start, end, stride)


def frame_stream(frames: Iterable[Any], camera: Camera | None = None) -> FrameStream:
    """Return a stream of the frames of any iterable: a list, a generator, a live camera. One frame is read at once.

    Args:
        frames: an iterable of `Frame`; or images, uint8 [H, W, 3] RGB, 30 a second; or pairs of an image and depth,
            float [H, W] metres with NaN for none. They are copied: a camera may reuse one array.
        camera: of all frames; None for a guess from the size of the first image.

    Raises:
        InputError: there is no frame, or one has another type.

    """
    if not isinstance(frames, Iterable):
        raise InputError(f"`frames` must be a folder, a video file or an iterable, got {type_and_shape(frames)}")
    counted = (_frame(item, index) for index, item in enumerate(frames))
    first = next(counted, None)
    if first is None:
        raise InputError("`frames` is empty; give at least one frame")
    _warn_of_unit(first)
    height, width = first.image.shape[:2]
    source = _in_order(itertools.chain([first], counted))
    return FrameStream(camera or Camera.guess(width, height), first.depth is not None, source)


def _in_order(frames: Iterator[Frame]) -> Iterator[Frame]:
    last = -1
    for frame in frames:
        if frame.index <= last:
            raise InputError(
                f"the index of `{frame.name}` must be above {last}, got {frame.index}: number the frames from 0 on, as "
                "`enumerate` does"
            )
        yield frame
        last = frame.index


def _warn_of_unit(frame: Frame) -> None:
    """Warn if all depth is outside the valid range, as in millimetres; all NaN is valid."""
    depth = frame.depth
    if not isinstance(depth, np.ndarray) or depth.dtype.kind != "f" or np.isnan(depth).all():
        return
    if not ((depth >= MIN_DEPTH) & (depth <= MAX_DEPTH)).any():
        warn(
            f"the depth of `{frame.name}` must be from {MIN_DEPTH:g} to {MAX_DEPTH:g} m, got {np.nanmin(depth):g} to "
            f"{np.nanmax(depth):g}: is it in metres (millimetres: divide by 1000.0)?"
        )


def _frame(item: Any, index: int) -> Frame:
    if isinstance(item, Frame):
        check_image(f"the image of `frames[{index}]`", item.image)
        return copied(item)
    image, depth = item if isinstance(item, tuple) and len(item) == 2 else (item, None)
    check_image(f"`frames[{index}]`", image)
    if depth is not None:
        check_depth(f"the depth of `frames[{index}]`", depth, image)
        depth = depth.astype(np.float32)
    return Frame(index, index / FRAMES_PER_SECOND, image.copy(), depth, f"frame {index}")


def copied(frame: Frame) -> Frame:
    """Return the frame with copies of its arrays."""
    return replace(frame, image=copy(frame.image), depth=copy(frame.depth))
