"""Static overlay mask: parts of the images that do not move with the scene.

Examples: black bars, a watermark, a time code, specks on the lens, a hand that holds the camera. Their corners and
edges are sharp and always visible, so tracking would follow them and find no motion (`benchmarks/static_overlay.py`).
So a sample of frames is searched before tracking.

A static pixel has the same gradient in every image: the sum of its gradients is as long as the sum of their lengths
(the mean resultant length of directional statistics). Elsewhere, while the camera moves, gradients of all directions
cancel. Gradients of letters on a changing background cancel, too, but their brightness is constant.

"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.robust import TINY
from vggtgeo.models.roles import Features, Segments

WIDTH = 480
"""Longer side of the reduced images that are compared, pixels: the smallest overlay (`MIN_AREA`) is
still 9 pixels wide."""
MIN_GRADIENT = 4.0
"""Grey levels a pixel, after a blur by one pixel: twice that of white noise of 10 grey levels."""
COHERENCE = 0.95
"""Mean resultant length above which a pixel is static. While the camera moves, at most 0.0001 of the pixels of a scene
are above 0.9 (`benchmarks/static_overlay.py`)."""
MAX_DEVIATION = 12.0
"""Largest deviation of a static pixel from its median brightness in nine of ten images, grey levels: that of a letter
that covers three quarters of the pixel."""
MIN_SEEN = 0.8
"""Minimum share of the images in which a pixel has a gradient: an overlay has it in all, except on a similar
background."""
MIN_AREA, MAX_AREA = 5e-4, 0.7
SURE_AREA = MAX_AREA / 2
"""Share of static pixels, with gaps and margins. Below the first there is no overlay: 0.0005 is a square of 9 pixels.
Above the second too little is left for tracking. Above half of that the mask is used with a warning, because a fixed
camera in front of a passing train looks the same."""
MIN_REPORTED = 0.1
"""Share of static pixels that cannot be masked above which a warning is given: with fewer, tracking has enough
others."""
CELL = 24
"""Side of a cell, pixels, a twentieth of the image. Each cell counts once, so that a detailed moving object does not
outweigh a plain static room."""
EMPTY = 0.03
"""Share of pixels with a gradient up to which a cell, or a row of a bar, is empty: noise and blocks of compression."""
STATIC_CELL, MAX_STATIC_CELLS = 0.6, 0.24
"""Mean coherence above which a cell is static, and the largest share of such cells for which the camera is moving: 0 to
0.2 if it moves, 0.3 to 0.8 if it stands (`benchmarks/static_overlay.py`)."""
MIN_CHANGED, CHANGE = 0.91, 0.5
"""Minimum share of the other pixels whose gradient changes by more than `CHANGE`, relatively, between images half a
sequence apart (median over pairs): 0.93 to 0.99 if the camera moves, 0.6 to 0.9 if a person walks in front of a fixed
camera. Without this test the room would be masked."""
MIN_IMAGES = 12
"""Minimum number of images: gradients of 12 random directions have a coherence of 0.95 with a chance below 1e-4."""
MAX_IMAGES, STRIDE = 20, 12
"""Maximum number of images, and frames between them: eight seconds."""
_EDGE, _THICK = 0.4, 4
"""A bar: empty rows or columns from the border of the image, followed within so many pixels by its edge, of which this
share is static: along dark parts of the image the edge is not visible."""
_GAP, _REACH = 6, 6
"""Pixels of the reduced images: gaps between letters of a text that are closed, and the margin within which a patch
still contains the overlay."""


@dataclass(frozen=True, eq=False)
class StaticOverlay:
    """The mask of a static overlay.

    mask: bool [H, W], True where a pixel belongs to the overlay. separable: False if too little of the scene remains
    for tracking: overlay and scene cannot be told apart.
    """

    mask: np.ndarray
    separable: bool = True

    @property
    def share(self) -> float:
        """Share of the image."""
        return float(self.mask.mean())

    @property
    def sure(self) -> bool:
        """Whether it is certainly an overlay, and not a static room."""
        return self.separable and self.share <= SURE_AREA

    def undistorted(self, camera: Camera) -> StaticOverlay:
        """Return the mask for images undistorted by `camera`."""
        return replace(self, mask=camera.undistorter().image(self.mask.astype(np.uint8) * 255) > 0)

    def without_points(self, features: Features) -> Features:
        """Return the key points outside the mask; those of networks that describe the whole image are unchanged."""
        descriptors: Any = features.descriptors
        vectors = getattr(descriptors, "vectors", None)
        if vectors is None or len(vectors) != len(features):
            return features
        keep = ~pinhole.at_pixels(self.mask, features.pixels)
        if keep.all():
            return features
        return Features(features.pixels[keep], features.scores[keep], replace(descriptors, vectors=vectors[keep]))

    def without_segments(self, segments: Segments) -> Segments:
        """Return the segments with neither their middle nor a quarter point on the mask."""
        ends = segments.endpoints
        along = [pinhole.at_pixels(self.mask, (1 - t) * ends[:, 0] + t * ends[:, 1]) for t in np.arange(1, 4) / 4]
        keep = ~np.logical_or.reduce(along)
        return Segments(ends[keep], segments.scores[keep])

    def without_depth(self, depth: np.ndarray) -> np.ndarray:
        """Return the depth, NaN on the mask: there it may be that of the scene behind, or of a hand in front."""
        return np.where(self.mask, np.float32(np.nan), depth).astype(depth.dtype)


def find_static_overlay(images: Iterable[np.ndarray]) -> StaticOverlay | None:
    """Return the static overlay of images uint8 [H, W, 3] of a moving camera.

    None without one, if the camera hardly moves, or for fewer than twelve images.
    """
    size, greys = (0, 0), []
    for image in images:
        size = image.shape[1], image.shape[0]
        greys.append(small_grey(image))
    return static_overlay_of(greys, size)


def static_overlay_of(greys: Sequence[np.ndarray], size: tuple[int, int]) -> StaticOverlay | None:
    """Return the static overlay of images reduced by `small_grey`; size: (W, H) before that."""
    count = len(greys)
    if count < MIN_IMAGES:
        return None
    gradients = [_gradient(grey) for grey in greys]
    lengths = [np.linalg.norm(gradient, axis=0) for gradient in gradients]
    length = np.sum(lengths, axis=0)
    coherence = np.linalg.norm(np.sum(gradients, axis=0), axis=0) / np.maximum(length, TINY)
    structured = length > MIN_GRADIENT * count
    seen = np.mean([one > MIN_GRADIENT for one in lengths], axis=0)
    often = structured & (seen > MIN_SEEN)
    coherent, kept = often & (coherence > COHERENCE), np.zeros_like(often)
    kept[often] = _constant_brightness(np.array([grey[often] for grey in greys]))
    still = coherent | kept
    if still.mean() < MIN_AREA:
        return None
    # A room before a camera that hardly moves keeps its brightness, too, and is not to be taken out of the rest.
    mask, rest = _filled(still, structured), ~_filled(coherent, structured)
    if np.median(_changed(gradients, lengths, rest)) < MIN_CHANGED:
        return None
    separable = bool(mask.mean() <= MAX_AREA) and _static_cells(coherence, structured & rest) <= MAX_STATIC_CELLS
    if not separable and coherent.mean() < MIN_REPORTED:
        return None
    full = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return StaticOverlay(np.asarray(full, bool), separable)


def small_grey(image: np.ndarray) -> np.ndarray:
    """Return an image uint8 [H, W, 3] reduced for the comparison: uint8 [h, w], longer side at most `WIDTH` pixels."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    factor = max(max(grey.shape) / WIDTH, 1.0)
    size = round(grey.shape[1] / factor), round(grey.shape[0] / factor)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))


def _constant_brightness(values: np.ndarray) -> np.ndarray:
    """Return which pixels have constant brightness, bool [m]; values: uint8 [images, m]."""
    off = np.abs(values - np.median(values, axis=0))
    return np.asarray(np.quantile(off, 0.9, axis=0) < MAX_DEVIATION, bool)


def _static_cells(coherence: np.ndarray, rest: np.ndarray) -> float:
    """Return the share of static cells among those with enough pixels in `rest`; 1 without any."""
    rows, columns = rest.shape[0] // CELL, rest.shape[1] // CELL
    sums = lambda image: image[: rows * CELL, : columns * CELL].reshape(rows, CELL, columns, CELL).sum(axis=(1, 3))
    count = sums(rest.astype(np.float32))
    enough = count > EMPTY * CELL**2
    mean = sums(np.where(rest, coherence, 0.0))[enough] / count[enough]
    return float(np.mean(mean > STATIC_CELL)) if enough.any() else 1.0


def _changed(gradients: list[np.ndarray], lengths: list[np.ndarray], where: np.ndarray) -> list[float]:
    """Return the share of pixels whose gradient changes, for each pair of images half a sequence apart."""
    found, apart = [], len(gradients) // 2
    for row in range(len(gradients) - apart):
        larger = np.maximum(lengths[row], lengths[row + apart])
        there = where & (larger > MIN_GRADIENT)
        step = np.linalg.norm(gradients[row + apart] - gradients[row], axis=0)
        found.append(float(np.mean(step[there] > CHANGE * larger[there])) if there.any() else 0.0)
    return found


def _gradient(grey: np.ndarray) -> np.ndarray:
    """Return the gradient by x and y, grey levels a pixel, float32 [2, h, w]."""
    # Derivatives amplify the noise of single pixels.
    # The weights of Sobel's kernel, times their distances, sum to 8.
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    return np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1 - axis, axis, ksize=3, scale=0.125) for axis in (0, 1)])


def _filled(still: np.ndarray, structured: np.ndarray) -> np.ndarray:
    """Return static pixels with the gaps between them, whole bars, and a margin."""
    mask = still.copy()
    for side in range(4):  # the turned arrays are views
        thickness = _bar(np.rot90(still, side), np.rot90(structured, side))
        np.rot90(mask, side)[:thickness] = True
    kernel = lambda radius: cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel(_GAP))
    return np.asarray(cv2.dilate(closed, kernel(_REACH)), bool)


def _bar(still: np.ndarray, structured: np.ndarray) -> int:
    """Return the rows of a bar at the upper border, including its edge; 0 without one."""
    full = np.flatnonzero(structured.mean(axis=1) > EMPTY)
    if not len(full) or full[0] < _THICK:
        return 0
    edge = still[full[0] : full[0] + _THICK].any(axis=0)
    return int(full[0]) + _THICK if edge.mean() > _EDGE else 0
