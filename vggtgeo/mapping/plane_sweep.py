"""Plane sweep: matching cost of every pixel of an image with its neighbours, at every depth.

A fronto-parallel plane at inverse depth `d` maps into a neighbour by the homography `H = K' (R + d t e3^T) K^-1`
(Collins, "A space-sweep approach to true multi-image matching", CVPR 1996). The neighbour's image is warped by it and
compared by the zero-mean normalised cross-correlation of windows, which is invariant to exposure gain and offset. The
image noise is added to the variances, so that untextured windows have correlation 0 at all depths. The cost is
truncated, so that an occluded neighbour adds a constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.geometry import pinhole

NOISE = 1.0
"""Standard deviation of the image noise, grey levels: 2 of a camera, halved by averaging four pixels."""
MAX_COST = 0.7
"""Truncation of the cost, 1 - correlation."""


@dataclass(frozen=True, eq=False)
class Photo:
    """An image with its pose. grey: float32 [H, W]; pose: float64 [4, 4], world -> camera; intrinsics: float64 [4]."""

    grey: np.ndarray
    pose: np.ndarray
    intrinsics: np.ndarray


def matching_cost(reference: Photo, others: Sequence[Photo], inverse_depths: np.ndarray, window: int) -> np.ndarray:
    """Return the cost of each pixel at each plane: the mean of `min(1 - correlation, MAX_COST)` over the neighbours
    that see it.

    Args:
        reference: image whose pixels are matched.
        others: its neighbours.
        inverse_depths: of the planes, float [k], 1/m.
        window: width of the correlation window, pixels, odd.

    Returns:
        float32 [H, W, k]; `MAX_COST` where no neighbour sees the point.

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
            inside, other_cost = own.compare(other.grey, far + inverse_depth * by_depth)
            total += other_cost
            seen += inside
        total /= np.maximum(seen, 1)
        total[seen == 0] = MAX_COST
    return np.ascontiguousarray(np.moveaxis(cost, 0, 2))


def plane_homographies(reference: Photo, other: Photo) -> tuple[np.ndarray, np.ndarray]:
    """Return H0 and H1, float64 [3, 3]: `H0 + d H1` maps pixels of `reference` to `other` for the plane `z = 1 / d`."""
    relative = other.pose @ np.linalg.inv(reference.pose)
    to_rays = np.linalg.inv(pinhole.matrix(reference.intrinsics))
    to_pixels = pinhole.matrix(other.intrinsics)
    return to_pixels @ relative[:3, :3] @ to_rays, np.outer(to_pixels @ relative[:3, 3], to_rays[2])


class _Window:
    """An image with mean and inverse standard deviation of each window, and buffers for comparisons.

    Buffers that are reused stay in the processor's cache, and two threads do not compete for the allocator.
    """

    def __init__(self, image: np.ndarray, window: int) -> None:
        self._image = image
        self._mean = box(image, window)
        variance = np.maximum(box(cv2.multiply(image, image), window) - self._mean * self._mean, 0)
        self._scale = 1.0 / np.sqrt(variance + NOISE**2)
        self._taps = np.full(window, 1 / window, np.float32)
        self._buffers = tuple(np.empty((5, *image.shape), np.float32))

    def compare(self, other: np.ndarray, homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the warped `other` has a pixel, bool [H, W], and the cost there, else 0, float32 [H, W].

        The cost is a buffer, valid until the next call.
        """
        warped, mean, square, product, spare = self._buffers
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.warpPerspective(other, homography, warped.shape[::-1], dst=warped, flags=flags, borderValue=-1e4)
        # The border value is negative, which no image is.
        inside = warped >= 0
        np.maximum(warped, 0, out=warped)
        self._mean_into(mean, warped)
        self._mean_into(square, cv2.multiply(warped, warped, dst=spare))
        self._mean_into(product, cv2.multiply(self._image, warped, dst=spare))
        square -= np.multiply(mean, mean, out=spare)
        np.maximum(square, 0, out=square)
        # Without it the correlation of untextured windows would be that of their noise.
        square += NOISE**2
        np.sqrt(square, out=square)
        product -= np.multiply(self._mean, mean, out=spare)
        product *= self._scale
        product /= square
        np.subtract(1.0, product, out=product)
        np.minimum(product, MAX_COST, out=product)
        product *= inside
        return inside, product

    def _mean_into(self, mean: np.ndarray, image: np.ndarray) -> None:
        """Compute `box`, accurate to 1e-7 of the largest value, in two thirds of its time."""
        cv2.sepFilter2D(image, cv2.CV_32F, self._taps, self._taps, dst=mean, borderType=cv2.BORDER_REFLECT_101)


def box(image: np.ndarray, window: int) -> np.ndarray:
    """Return the mean of the `window` x `window` pixels around each pixel."""
    mean: np.ndarray = cv2.boxFilter(image, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REFLECT_101)
    return mean
