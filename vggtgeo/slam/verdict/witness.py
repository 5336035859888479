"""The witness of the verdict: corners followed from image to image, and the measured depth there.

The tracks (Lucas & Kanade, 1981, on images of 320 pixels) are independent of the map, its features and its poses. About
4 ms a frame (640 x 480), 4 kB a frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.given import check_kind
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.state import Slam

WIDTH = 320
"""Pixels of the longer side of the images that corners are followed in."""
CELL = 20
"""Pixels of these images a side of a cell. A cell holds one track: a poster does not outvote the walls around it."""
MIN_CORNER = 2e-5
"""Smallest eigenvalue of the structure tensor (OpenCV's unit). White noise of 3 grey levels gives 1e-5."""
CONTRAST = 50.0
"""Grey levels, standard deviation."""
AROUND = 19
"""Pixels of these images, side of the square (twice) whose mean is the brightness around a pixel."""
LIGHT_REMOVED = 0.7
"""Share of that brightness that is taken away. With more, or a smaller square, little is left to follow on white walls,
whose shades are soft, and in pictures that are smeared (`benchmarks/followed_corners.py`)."""
DARKEST = 0.3
"""Of the mean brightness: darker surroundings are not made brighter than this allows; they are noise."""
BANDS = 8.0
"""Grey levels of these images by which two in a row must differ (root mean square over the rows) in what is common to
a row, for bands of light to be looked for. Without any 0.5 to 4.6 in the middle of a clip, 13 in turns; with 10 to 28
(`benchmarks/followed_corners.py`)."""
MORE = 1.2
"""Times as many corners come back without them: then these are bands."""
ROUND_TRIP = 0.5
"""Pixels of these images: forth and back again must end where it began. LK's own noise is 0.05 to 0.1 pixels."""
STRIDE = 8
"""Pixels between the depths that are kept of the last frame."""
MAX_WAITING = 4
"""Frames that wait to be looked at; they hold their images."""
_PATCH = (15, 15)
_FLOW = {
    "winSize": _PATCH,
    "maxLevel": 4,
    "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.03),
}


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
        """The same corners without the distortion of `lens`."""
        return replace(self, pixels=lens.undistorted(self.pixels).astype(np.float32))


@dataclass(frozen=True, eq=False)
class EvidenceSoFar:
    """State of an `EvidenceRecorder`: the frames so far; of the last one the small grey image, every `STRIDE`-th depth,
    and the corners with their tracks' numbers; the next number.
    """

    frames: tuple[FrameEvidence, ...]
    image: np.ndarray | None
    depth: np.ndarray | None
    ids: np.ndarray
    pixels: np.ndarray
    next: int


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
        small = cv2.resize(still.astype(np.uint8), _small_size(still.shape), interpolation=cv2.INTER_AREA)
        self._left_out = cv2.dilate(small, np.ones(_PATCH, np.uint8)) > 0

    @property
    def frames(self) -> list[FrameEvidence]:
        """Evidence of each frame so far."""
        while self._waiting:
            self._waiting.popleft().result()
        return self._frames

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Follow the corners in a thread of its own, beside the run."""
        while len(self._waiting) > MAX_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._pool.submit(self._add, frame))

    def so_far(self) -> EvidenceSoFar:
        """State to resume from."""
        return EvidenceSoFar(tuple(self.frames), self._image, self._depth, self._ids, self._pixels, self._next)

    def on_resume(self, so_far: EvidenceSoFar, slam: Slam) -> None:
        """Continue after the last of these frames."""
        self._frames = list(so_far.frames)
        self._image, self._depth, self._next = so_far.image, so_far.depth, so_far.next
        self._ids, self._pixels = so_far.ids, so_far.pixels
        self._owned = so_far.depth is None or bool(np.isfinite(so_far.frames[-1].depth).any())

    def add(self, frame: Frame) -> None:
        """Follow the corners into this frame, and detect new ones where there are none."""
        self.frames  # noqa: B018 - what came before is noted before
        self._add(frame)

    def _add(self, frame: Frame) -> None:
        scale = max(frame.image.shape[:2]) / WIDTH
        grey = _small_grey(frame.image)
        if self._image is not None and len(self._ids):
            pixels, kept = _follow_through_bands(self._image, grey, self._pixels)
            kept &= self._of_the_world(pixels)
            self._ids, self._pixels = one_a_cell(self._ids[kept], pixels[kept])
        fresh = new_corners(grey, self._pixels)
        fresh = fresh[self._of_the_world(fresh)]
        numbers = np.arange(self._next, self._next + len(fresh), dtype=np.int32)
        self._next += len(fresh)
        self._ids = np.concatenate([self._ids, numbers])
        self._pixels = np.concatenate([self._pixels, fresh])
        full = (self._pixels + 0.5) * scale - 0.5
        own = self._own_depth(frame.depth, grey)
        depth = np.full(len(full), np.nan, np.float32) if own is None else _read(own, full)
        self._image = grey
        ideal = self._camera.undistorted(full).astype(np.float32)
        self._frames.append(FrameEvidence(frame.index, frame.timestamp, self._ids.copy(), ideal, depth))

    def _own_depth(self, depth: np.ndarray | None, grey: np.ndarray) -> np.ndarray | None:
        """The depth image, unless it repeats that of another picture: the run does not use it either."""
        before, small = self._depth, None if depth is None else depth[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        self._depth = None if small is None else small.copy()
        same = before is not None and small is not None and np.array_equal(before, small, equal_nan=True)
        if not same:
            self._owned = True
        elif self._image is None or not np.array_equal(grey, self._image):
            self._owned = False
        return depth if self._owned else None

    def _of_the_world(self, pixels: np.ndarray) -> np.ndarray:
        """Which corners of the small image may be followed."""
        if self._left_out is None:
            return np.ones(len(pixels), bool)
        column, row = np.clip(np.rint(pixels), 0, np.array(self._left_out.shape[::-1]) - 1).astype(int).T
        return ~self._left_out[row, column]


def follow(before: np.ndarray, after: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where corners of one grey image are in the next, float32 [m, 2], and which of them came back when asked."""
    start = pixels.reshape(-1, 1, 2)
    there, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, start, None, **_FLOW)
    back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None, **_FLOW)
    off = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    moved = there.reshape(-1, 2)
    height, width = after.shape
    inside = (moved > 4).all(1) & (moved < (width - 5, height - 5)).all(1)
    return moved, (ok.ravel() == 1) & (again.ravel() == 1) & (off < ROUND_TRIP) & inside


def _follow_through_bands(before: np.ndarray, after: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `follow`, where lamps may have flickered while the rows (of a picture that was turned: the columns) were read:
    without what most of a row has in common with the change, if that helps.
    """
    moved, kept = follow(before, after, pixels)
    bands = common_to_rows(before, after)
    if np.sqrt(np.mean(bands**2)) <= BANDS:
        return moved, kept
    steady = np.clip(after - bands, 0, 255).astype(np.uint8)
    others, again = follow(before, steady, pixels)
    return (others, again) if np.count_nonzero(again) > MORE * np.count_nonzero(kept) else (moved, kept)


def common_to_rows(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """By how much most of each row (column, of an upright picture) became brighter: float64 [h, 1] ([1, w])."""
    along = 1 if after.shape[1] >= after.shape[0] else 0
    some = (slice(None), slice(None, None, 4)) if along else (slice(None, None, 4), slice(None))
    return np.asarray(np.median(after[some].astype(np.int16) - before[some], axis=along, keepdims=True))


def one_a_cell(ids: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The oldest track of each cell; ids grow with time, and rows are in their order."""
    cells = (pixels // CELL).astype(int)
    _, first = np.unique(cells[:, 0] + 10_000 * cells[:, 1], return_index=True)
    kept = np.sort(first)
    return ids[kept], pixels[kept]


def new_corners(grey: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """The strongest corner of each cell that holds none of `taken`, float32 [m, 2]."""
    strength = cv2.cornerMinEigenVal(grey, 5)
    rows, columns = grey.shape[0] // CELL, grey.shape[1] // CELL
    cells = strength[: rows * CELL, : columns * CELL].reshape(rows, CELL, columns, CELL)
    cells = cells.transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    best = cells.argmax(2)
    free = cells.max(2) > MIN_CORNER
    x, y = np.clip(taken // CELL, 0, (columns - 1, rows - 1)).astype(int).T
    free[y, x] = False
    row, column = np.nonzero(free)
    inner = best[row, column]
    return np.column_stack([column * CELL + inner % CELL, row * CELL + inner // CELL]).astype(np.float32)


def _small_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """Width and height of the image that corners are followed in; shape: of the one that was read."""
    scale = max(shape) / WIDTH
    height, width = (max(round(side / scale), 2 * CELL) for side in shape)
    return width, height


def _small_grey(image: np.ndarray) -> np.ndarray:
    """The image that corners are followed in, uint8.

    Lucas and Kanade compare grey levels, and a camera changes its exposure, a lamp flickers: so each pixel is compared
    with the brightness around it. Not with that of its row, which bands of light would call for: what enters a row far
    away would then move its corners.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, _small_size(grey.shape), interpolation=cv2.INTER_AREA)
    mean, deviation = max(float(small.mean()), 1.0), float(small.std())
    square = (AROUND, AROUND)
    levels = small.astype(np.float32)
    around = cv2.blur(cv2.blur(levels, square), square)
    detail = levels - LIGHT_REMOVED * around - (1 - LIGHT_REMOVED) * mean
    detail *= mean / np.maximum(around, DARKEST * mean)
    gain = min(CONTRAST / max(deviation, 1e-3), 4.0)
    return np.clip(gain * detail + 128.0, 0, 255).astype(np.uint8)


def _read(depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    columns, rows = np.rint(pixels).astype(int).T
    height, width = depth.shape
    return depth[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float32)


Evidence = Sequence[FrameEvidence]
