"""Corners followed from image to image (Lucas & Kanade, 1981), on images of 320 pixels.

About 4 ms a frame (640 x 480).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from vggtgeo.geometry import pinhole

WIDTH = 320
"""Pixels of the longer side of the images that corners are followed in: half of VGA, so that a frame takes 4 ms."""
CELL = 20
"""Pixels of these images a side of a cell. A cell holds one track: a poster does not outvote the walls around it."""
MIN_CORNER = 2e-5
"""Smallest eigenvalue of the structure tensor (OpenCV's unit). White noise of 3 grey levels gives 1e-5."""
CONTRAST = 50.0
"""Grey levels, standard deviation that all images are brought to: 2.5 of them reach from middle grey to black."""
AROUND = CELL - 1
"""Pixels of these images, side of the square (twice) whose mean is the brightness around a pixel: about a cell, and
odd, so that the pixel is in its middle."""
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
"""Times as many corners come back without them: then these are bands. Of 150 corners, 20 % more are more than
chance."""
ROUND_TRIP = 0.5
"""Pixels of these images: forth and back again must end where it began. LK's own noise is 0.05 to 0.1 pixels."""
PATCH = 15
"""Pixels: smaller patches of these images are ambiguous, larger ones cross depth edges."""
LEVELS, LEVELS_FROM_SHIFT = 4, 2
"""Of the image pyramid, beyond the images themselves: reach of 100 pixels, and of 25 around the translation."""
REDUCTION = 4
"""Of the images whose translation is searched: it need only be right within half a patch."""
_FLOW = {
    "winSize": (PATCH, PATCH),
    # Below the noise of 0.05 pixels after a few steps; the limit is for corners that do not settle.
    "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.03),
    "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
}


class FollowedCorners(NamedTuple):
    """Corners of an image and their tracks.

    image: uint8 [h, w], of `small_grey`; None before the first one. ids: int32 [m], number of each corner's track, in
    the order of their beginning. pixels: float32 [m, 2]. next_id: number of the next track.
    """

    image: np.ndarray | None = None
    ids: np.ndarray = np.zeros(0, np.int32)
    pixels: np.ndarray = np.zeros((0, 2), np.float32)
    next_id: int = 0

    def into(self, grey: np.ndarray, mask: np.ndarray | None) -> FollowedCorners:
        """Follow the corners into the next image, and detect new ones where there are none.

        mask: bool [h, w], of `small_mask`: no corner is followed there.
        """
        outside = lambda at: np.ones(len(at), bool) if mask is None else ~pinhole.at_pixels(mask, at)
        ids, pixels = self.ids, self.pixels
        if self.image is not None and len(ids):
            pixels, kept = follow_through_bands(self.image, grey, pixels)
            kept &= outside(pixels)
            ids, pixels = one_a_cell(ids[kept], pixels[kept])
        fresh = new_corners(grey, pixels)
        fresh = fresh[outside(fresh)]
        next_id = self.next_id + len(fresh)
        ids = np.concatenate([ids, np.arange(self.next_id, next_id, dtype=np.int32)])
        return FollowedCorners(grey, ids, np.concatenate([pixels, fresh]), next_id)


def follow(before: np.ndarray, after: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Follow corners from one grey image to the next; return where they are, and which came back to their start.

    In a fast turn corners move farther than Lucas and Kanade's pyramid reaches: those that are not found where they
    were are searched once more from the translation of the whole picture. Positions are float32 [m, 2], pixels.
    """
    moved, kept = _follow_from(before, after, pixels, np.zeros(2, np.float32), LEVELS)
    shift = translation(before, after)
    if kept.all() or np.linalg.norm(shift) <= PATCH / 2:
        return moved, kept
    others, again = _follow_from(before, after, pixels, shift, LEVELS_FROM_SHIFT)
    return np.where(kept[:, None], moved, others), kept | again


def _follow_from(
    before: np.ndarray, after: np.ndarray, pixels: np.ndarray, shift: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    start = pixels.reshape(-1, 1, 2)
    there, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, start, start + shift, maxLevel=levels, **_FLOW)
    back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, there, there - shift, maxLevel=levels, **_FLOW)
    off = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    moved = there.reshape(-1, 2)
    height, width = after.shape
    inside = (moved > 4).all(1) & (moved < (width - 5, height - 5)).all(1)
    return moved, (ok.ravel() == 1) & (again.ravel() == 1) & (off < ROUND_TRIP) & inside


def translation(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the translation between two grey images by phase correlation, float32 [2], pixels."""
    height, width = (side // REDUCTION for side in before.shape)
    small = [
        cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) for image in (before, after)
    ]
    shift, _ = cv2.phaseCorrelate(*small, cv2.createHanningWindow((width, height), cv2.CV_32F))
    return REDUCTION * np.array(shift, np.float32)


def follow_through_bands(before: np.ndarray, after: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `follow`, without brightness changes that most of a row shares, if that helps.

    Lamps may have flickered while the rows (of a rotated picture: the columns) were read.
    """
    moved, kept = follow(before, after, pixels)
    bands = common_to_rows(before, after)
    if np.sqrt(np.mean(bands**2)) <= BANDS:
        return moved, kept
    steady = np.clip(after - bands, 0, 255).astype(np.uint8)
    others, again = follow(before, steady, pixels)
    return (others, again) if np.count_nonzero(again) > MORE * np.count_nonzero(kept) else (moved, kept)


def common_to_rows(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return by how much most of each row (column, of an upright picture) became brighter: float64 [h, 1] ([1, w])."""
    along = 1 if after.shape[1] >= after.shape[0] else 0
    some = (slice(None), slice(None, None, 4)) if along else (slice(None, None, 4), slice(None))
    return np.asarray(np.median(after[some].astype(np.int16) - before[some], axis=along, keepdims=True))


def one_a_cell(ids: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the oldest track of each cell; ids grow with time, and rows are in their order."""
    kept = np.sort(np.unique(pixels // CELL, axis=0, return_index=True)[1])
    return ids[kept], pixels[kept]


def new_corners(grey: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """Return the strongest corner of each cell that contains none of `taken`, float32 [m, 2]."""
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


def small_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return width and height of the image that corners are followed in. shape: of the image as read."""
    scale = max(shape) / WIDTH
    height, width = (max(round(side / scale), 2 * CELL) for side in shape)
    return width, height


def small_mask(mask: np.ndarray) -> np.ndarray:
    """Return a mask, bool [H, W], for the image that corners are followed in, wider by the patch around a corner."""
    small = cv2.resize(mask.astype(np.uint8), small_size(mask.shape), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.dilate(small, np.ones((PATCH, PATCH), np.uint8)) > 0)


def small_grey(image: np.ndarray) -> np.ndarray:
    """Return the image that corners are followed in, uint8.

    Lucas and Kanade compare grey levels, and a camera changes its exposure, a lamp flickers: so each pixel is compared
    with the brightness around it. Not with that of its row, which bands of light would call for: what enters a row far
    away would then move its corners.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, small_size(grey.shape), interpolation=cv2.INTER_AREA)
    mean, deviation = max(float(small.mean()), 1.0), float(small.std())
    square = (AROUND, AROUND)
    levels = small.astype(np.float32)
    around = cv2.blur(cv2.blur(levels, square), square)
    detail = levels - LIGHT_REMOVED * around - (1 - LIGHT_REMOVED) * mean
    detail *= mean / np.maximum(around, DARKEST * mean)
    gain = CONTRAST / max(deviation, CONTRAST / 4.0)
    # About middle grey, where clipping takes as little from bright as from dark details.
    return np.clip(gain * detail + 128.0, 0, 255).astype(np.uint8)
