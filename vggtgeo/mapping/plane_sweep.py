"""Plane sweep: how well a picture agrees with its neighbours, for every pixel at every depth.

A plane at inverse depth `d`, parallel to the image, is carried into a neighbour by the homography
`H = K' (R + d t e3^T) K^-1` (Collins, "A space-sweep approach to true multi-image matching", CVPR 1996). The
neighbour's picture is warped by it, and compared by the zero-mean normalised cross-correlation of windows, which gain
and offset of the exposure leave alone. A correlation is damped by the image's noise, so that a blank wall agrees with
nothing and costs the same everywhere; it is cut off, so that a neighbour that sees something else costs the same
everywhere, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.models import pinhole

NOISE = 1.0
"""Standard deviation of the image noise, grey levels: a camera has 2, and a pixel of the search is the mean of four."""
WORST = 0.7
"""Largest cost, 1 - correlation: what agrees less is another surface."""


@dataclass(frozen=True, eq=False)
class Photo:
    """A picture with its pose. grey: float32 [H, W]; pose: float64 [4, 4], world -> camera; intrinsics: float64 [4]."""

    grey: np.ndarray
    pose: np.ndarray
    intrinsics: np.ndarray


def matching_cost(reference: Photo, others: Sequence[Photo], inverse_depths: np.ndarray, window: int) -> np.ndarray:
    """The cost of each pixel at each plane: the mean over the neighbours that see it of `min(1 - correlation, WORST)`.

    Args:
        reference: whose pixels are asked.
        others: its neighbours.
        inverse_depths: of the planes, float [k], 1/m.
        window: width of the compared windows, pixels, odd.

    Returns:
        float32 [H, W, k]; `WORST` where no neighbour sees the place.

    """
    height, width = reference.grey.shape
    own = _Window(reference.grey, window)
    homographies = [plane_homographies(reference, other) for other in others]
    cost = np.empty((len(inverse_depths), height, width), np.float32)
    seen = np.empty((height, width), np.float32)
    for plane, inverse_depth in enumerate(inverse_depths):
        total = cost[plane]
        total[:], seen[:] = 0, 0
        for other, (far, by_depth) in zip(others, homographies, strict=True):
            inside, differing = own.compared(other.grey, far + inverse_depth * by_depth)
            total += differing
            seen += inside
        total /= np.maximum(seen, 1)
        total[seen == 0] = WORST
    return np.ascontiguousarray(np.moveaxis(cost, 0, 2))


def plane_homographies(reference: Photo, other: Photo) -> tuple[np.ndarray, np.ndarray]:
    """From pixels of `reference` to those of `other`: that of the plane `z = 1 / d` is the first, which is that of what
    is infinitely far, plus `d` times the second; float64 [3, 3] each.
    """
    relative = other.pose @ np.linalg.inv(reference.pose)
    to_rays = np.linalg.inv(pinhole.matrix(reference.intrinsics))
    to_pixels = pinhole.matrix(other.intrinsics)
    return to_pixels @ relative[:3, :3] @ to_rays, np.outer(to_pixels @ relative[:3, 3], to_rays[2])


class _Window:
    """A picture, with mean and inverse deviation of the window around each pixel, and room to compare others with it:
    arrays that are made once stay in the processor's cache, and two threads do not wait for new ones.
    """

    def __init__(self, image: np.ndarray, window: int) -> None:
        self._image = image
        self._mean = box(image, window)
        variance = np.maximum(box(cv2.multiply(image, image), window) - self._mean * self._mean, 0)
        self._scale = 1.0 / np.sqrt(variance + NOISE**2)
        self._taps = np.full(window, 1 / window, np.float32)
        self._room = tuple(np.empty((5, *image.shape), np.float32))

    def compared(self, other: np.ndarray, map_to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where another picture, warped by `map_to`, has a pixel, bool [H, W], and `min(1 - correlation, WORST)` there,
        0 elsewhere, float32 [H, W]; the latter until the next call.
        """
        warped, mean, square, product, spare = self._room
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.warpPerspective(other, map_to, warped.shape[::-1], dst=warped, flags=flags, borderValue=-1e4)
        inside = warped >= 0
        np.maximum(warped, 0, out=warped)
        self._mean_into(mean, warped)
        self._mean_into(square, cv2.multiply(warped, warped, dst=spare))
        self._mean_into(product, cv2.multiply(self._image, warped, dst=spare))
        square -= np.multiply(mean, mean, out=spare)
        np.maximum(square, 0, out=square)
        square += NOISE**2
        np.sqrt(square, out=square)
        product -= np.multiply(self._mean, mean, out=spare)
        product *= self._scale
        product /= square
        np.subtract(1.0, product, out=product)
        np.minimum(product, WORST, out=product)
        product *= inside
        return inside, product

    def _mean_into(self, mean: np.ndarray, image: np.ndarray) -> None:
        """As `box`, in two thirds of its time, to 1e-7 of the largest value."""
        cv2.sepFilter2D(image, cv2.CV_32F, self._taps, self._taps, dst=mean, borderType=cv2.BORDER_REFLECT_101)


def box(image: np.ndarray, window: int) -> np.ndarray:
    """The mean of the `window` x `window` pixels around each."""
    mean: np.ndarray = cv2.boxFilter(image, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REFLECT_101)
    return mean
