"""Recorder of the corner tracks with which the verdict tests a run, and of the measured depth at them.

The tracks are independent of the map, its features and its poses. About 4 ms and 4 kB a frame (640 x 480).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import pinhole
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.argument_checks import check_kind
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.perception.klt_corners import WIDTH, FollowedCorners, small_grey, small_mask
from vggtgeo.slam.state import Slam

SOME = slice(4, None, 8)
"""Rows and columns of the depth that is kept of the last frame."""
MAX_QUEUED_FRAMES = 4
"""Maximum number of frames that wait for the recorder's thread; they hold their images."""


@dataclass(frozen=True, eq=False)
class FrameCorners:
    """The corners of one frame. ids: int32 [m], a track's number, the same in each frame that saw it. pixels: float32
    [m, 2], of the ideal pinhole image. depth: float32 [m], measured, metres; NaN where there is none, or the image
    repeats that of another picture.
    """

    frame: int
    timestamp: float
    ids: np.ndarray
    pixels: np.ndarray
    depth: np.ndarray

    def common(self, other: FrameCorners) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of the tracks that both frames saw, here and there, int [n] each."""
        _, rows, others = np.intersect1d(self.ids, other.ids, assume_unique=True, return_indices=True)
        return rows, others


CornerTracks = Sequence[FrameCorners]
"""The corners of each frame of a run; equal ids are one track."""


class CornerRecorder(Callback):
    """Record a `FrameCorners` of each frame, for `vggtgeo.Result.of`.

    Example:
        >>> import vggtgeo as vg
        >>> sequence = vg.simulate("room", 3, size=(160, 120))
        >>> recorder = vg.callbacks.CornerRecorder(sequence.camera)
        >>> for frame in sequence.frames():
        ...     recorder.add(frame)
        >>> len(recorder.frames)
        3

    """

    def __init__(self, camera: Camera) -> None:
        check_kind("camera", camera, Camera, "a `vggtgeo.Camera`, as `sequence.camera`")
        self._camera = camera
        self._mask: np.ndarray | None = None
        self._frames: list[FrameCorners] = []
        self._waiting: deque[Future[None]] = deque()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="evidence")
        self._corners = FollowedCorners()
        self._depth: np.ndarray | None = None
        self._owned = True

    def leave_out(self, still: np.ndarray) -> None:
        """Follow no corners on `still`, bool [H, W], the static part of the picture."""
        self._mask = small_mask(still)

    @property
    def frames(self) -> list[FrameCorners]:
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
        frames = tuple(self.frames)  # first: it waits for the corners of the last one
        image, *tracks = self._corners
        return frames, image, self._depth, *tracks

    def on_resume(self, so_far: Any, slam: Slam) -> None:
        frames, image, self._depth, *tracks = so_far
        self._frames, self._corners = list(frames), FollowedCorners(image, *tracks)
        self._owned = self._depth is None or bool(np.isfinite(frames[-1].depth).any())

    def add(self, frame: Frame) -> None:
        """Follow the corners into this frame, and detect new ones where there are none."""
        self.frames  # noqa: B018 - what came before is noted before
        self._add(frame)

    def _add(self, frame: Frame) -> None:
        grey, last = small_grey(frame.image), self._corners.image
        same_picture = last is not None and np.array_equal(grey, last)
        self._corners = self._corners.into(grey, self._mask)
        pixels = (self._corners.pixels + 0.5) * (max(frame.image.shape[:2]) / WIDTH) - 0.5
        depth = self._depth_at(pixels, frame.depth, same_picture)
        ideal = self._camera.undistorted(pixels).astype(np.float32)
        self._frames.append(FrameCorners(frame.index, frame.timestamp, self._corners.ids, ideal, depth))

    def _depth_at(self, pixels: np.ndarray, depth: np.ndarray | None, same_picture: bool) -> np.ndarray:
        """Return depths at pixels; NaN if the image repeats that of another picture: the run does not use it either."""
        before, now = self._depth, None if depth is None else depth[SOME, SOME].copy()
        same_depth = before is not None and now is not None and np.array_equal(before, now, equal_nan=True)
        self._depth, self._owned = now, not same_depth or (self._owned and same_picture)
        if depth is None or not self._owned:
            return np.full(len(pixels), np.nan, np.float32)
        return pinhole.at_pixels(depth, pixels).astype(np.float32)
