"""Recorder of the corner tracks with which the verdict tests a run, and of the measured depth at them.

The tracks (Lucas & Kanade, 1981, on images of 320 pixels) are independent of the map, its features and its poses. About
4 ms a frame (640 x 480), 4 kB a frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.given import check_kind
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.perception.followed_corners import (
    PATCH,
    WIDTH,
    follow_through_bands,
    new_corners,
    one_a_cell,
    small_grey,
    small_size,
)
from vggtgeo.slam.state import Slam

STRIDE = 8
"""Pixels between the depths that are kept of the last frame."""
MAX_QUEUED_FRAMES = 4
"""Maximum number of frames that wait for the recorder's thread; they hold their images."""


@dataclass(frozen=True, eq=False)
class FrameEvidence:
    """The corners of one frame.

    ids: int32 [m], a track's number, the same in each frame that saw it. pixels: float32 [m, 2], of the ideal pinhole
    image. depth: float32 [m], measured, metres; NaN where there is none, or the image repeats that of another picture.
    """

    frame: int
    timestamp: float
    ids: np.ndarray
    pixels: np.ndarray
    depth: np.ndarray

    def through(self, lens: Camera) -> FrameEvidence:
        """Return the same corners without the distortion of `lens`."""
        return replace(self, pixels=lens.undistorted(self.pixels).astype(np.float32))


class EvidenceRecorder(Callback):
    """Record a `FrameEvidence` of each frame, for `vggtgeo.Result.of`.

    Example:
        >>> import vggtgeo as vg
        >>> sequence = vg.simulate("room", 3, size=(160, 120))
        >>> recorder = vg.callbacks.EvidenceRecorder(sequence.camera)
        >>> for frame in sequence.frames():
        ...     recorder.add(frame)
        >>> len(recorder.frames)
        3

    """

    def __init__(self, camera: Camera) -> None:
        check_kind("camera", camera, Camera, "a `vggtgeo.Camera`, as `sequence.camera`")
        self._left_out: np.ndarray | None = None
        self._frames: list[FrameEvidence] = []
        self._waiting: deque[Future[None]] = deque()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="evidence")
        self._camera = camera
        self._image: np.ndarray | None = None
        self._depth: np.ndarray | None = None
        self._owned = True
        self._ids = np.zeros(0, np.int32)
        self._pixels = np.zeros((0, 2), np.float32)
        self._next = 0

    def leave_out(self, still: np.ndarray) -> None:
        """Mask `still`, bool [H, W], the static part of the picture, with a margin of the patch around a corner."""
        small = cv2.resize(still.astype(np.uint8), small_size(still.shape), interpolation=cv2.INTER_AREA)
        self._left_out = cv2.dilate(small, np.ones(PATCH, np.uint8)) > 0

    @property
    def frames(self) -> list[FrameEvidence]:
        """The corners of each frame so far."""
        while self._waiting:
            self._waiting.popleft().result()
        return self._frames

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Follow the corners in a thread of its own, beside the run."""
        while len(self._waiting) > MAX_QUEUED_FRAMES:
            self._waiting.popleft().result()
        self._waiting.append(self._pool.submit(self._add, frame))

    def so_far(self) -> tuple[object, ...]:
        """Return the state to resume from."""
        return tuple(self.frames), self._image, self._depth, self._ids, self._pixels, self._next

    def on_resume(self, so_far: Any, slam: Slam) -> None:
        """Continue after the last of these frames."""
        frames, self._image, self._depth, self._ids, self._pixels, self._next = so_far
        self._frames = list(frames)
        self._owned = self._depth is None or bool(np.isfinite(frames[-1].depth).any())

    def add(self, frame: Frame) -> None:
        """Follow the corners into this frame, and detect new ones where there are none."""
        self.frames  # noqa: B018 - what came before is noted before
        self._add(frame)

    def _add(self, frame: Frame) -> None:
        scale = max(frame.image.shape[:2]) / WIDTH
        grey = small_grey(frame.image)
        if self._image is not None and len(self._ids):
            pixels, kept = follow_through_bands(self._image, grey, self._pixels)
            kept &= self._of_the_world(pixels)
            self._ids, self._pixels = one_a_cell(self._ids[kept], pixels[kept])
        fresh = new_corners(grey, self._pixels)
        fresh = fresh[self._of_the_world(fresh)]
        numbers = np.arange(self._next, self._next + len(fresh), dtype=np.int32)
        self._next += len(fresh)
        self._ids = np.concatenate([self._ids, numbers])
        self._pixels = np.concatenate([self._pixels, fresh])
        full = (self._pixels + 0.5) * scale - 0.5
        depth = self._read(frame.depth, grey, full)
        self._image = grey
        ideal = self._camera.undistorted(full).astype(np.float32)
        self._frames.append(FrameEvidence(frame.index, frame.timestamp, self._ids.copy(), ideal, depth))

    def _read(self, depth: np.ndarray | None, grey: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return depths at pixels; NaN if the image repeats that of another picture: the run does not use it either."""
        some = slice(STRIDE // 2, None, STRIDE)
        before, self._depth = self._depth, None if depth is None else depth[some, some].copy()
        if before is None or self._depth is None or not np.array_equal(before, self._depth, equal_nan=True):
            self._owned = True
        elif self._image is None or not np.array_equal(grey, self._image):
            self._owned = False
        if depth is None or not self._owned:
            return np.full(len(pixels), np.nan, np.float32)
        row, column = np.clip(np.rint(pixels[:, ::-1]), 0, np.array(depth.shape) - 1).astype(int).T
        return depth[row, column].astype(np.float32)

    def _of_the_world(self, pixels: np.ndarray) -> np.ndarray:
        """Return which corners of the small image may be followed."""
        if self._left_out is None:
            return np.ones(len(pixels), bool)
        column, row = np.clip(np.rint(pixels), 0, np.array(self._left_out.shape[::-1]) - 1).astype(int).T
        return ~self._left_out[row, column]


CornerTracks = Sequence[FrameEvidence]
"""The corners of each frame of a run; equal ids are one track."""
