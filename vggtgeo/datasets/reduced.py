"""Reduction of large images: the pipeline detects and judges corners in pixels.

Pixel noise and search radii are constants of the pipeline, measured on images of 540 x 360 to 752 x 480. Phones record
1920 x 1080 and 3840 x 2160, where corners are blurred over several pixels and the same error is many pixels: a sequence
without intrinsics that initializes at 540 x 360 does not when it is enlarged to 3840 x 2160.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import overload

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame, Sequence, check_frame
from vggtgeo.datasets.in_memory import FrameStream
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class ReducedSequence:
    """`source` with smaller images and depth; `camera` is that of the reduced images."""

    source: Sequence
    camera: Camera

    @property
    def name(self) -> str:
        """Return the name of the source."""
        return self.source.name

    @property
    def has_depth(self) -> bool:
        """Return whether the source has depth."""
        return self.source.has_depth

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`."""
        return _reduced_frames(self.source.frames(start, end, stride), self.source.camera, self.camera)

    def ground_truth(self) -> Trajectory | None:
        """Return the truth of the source."""
        return self.source.ground_truth()


@overload
def reduced(source: Sequence, max_pixels: int) -> Sequence: ...


@overload
def reduced(source: FrameStream, max_pixels: int) -> FrameStream: ...


def reduced(source: Sequence | FrameStream, max_pixels: int) -> Sequence | FrameStream:
    """Return the frames and camera reduced to about `max_pixels` pixels; the source itself if its images are smaller,
    or if `max_pixels` is 0.
    """
    camera = reduced_camera(source.camera, max_pixels)
    if camera == source.camera:
        return source
    if isinstance(source, FrameStream):
        return replace(source, camera=camera, source=_reduced_frames(source.source, source.camera, camera))
    return ReducedSequence(source, camera)


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
        if depth is not None:  # a mean over an edge would be on no surface
            depth = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
        yield replace(frame, image=image, depth=depth)
