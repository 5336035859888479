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
    own = _Window.of(reference.grey, window)
    cost = np.empty((len(inverse_depths), height, width), np.float32)
    for plane, inverse_depth in enumerate(inverse_depths):
        total, seen = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
        for other in others:
            map_to = plane_homography(reference, other, float(inverse_depth))
            warped = _warp(other.grey, map_to, (width, height))
            inside = warped >= 0
            score = own.correlation(_Window.of(np.maximum(warped, 0), window), window)
            total += np.where(inside, np.minimum(1.0 - score, WORST), 0)
            seen += inside
        cost[plane] = np.where(seen > 0, total / np.maximum(seen, 1), WORST)
    return np.ascontiguousarray(np.moveaxis(cost, 0, 2))


def plane_homography(reference: Photo, other: Photo, inverse_depth: float) -> np.ndarray:
    """Float64 [3, 3], from pixels of `reference` to those of `other`, of the plane `z = 1 / inverse_depth`."""
    relative = other.pose @ np.linalg.inv(reference.pose)
    motion = relative[:3, :3].copy()
    motion[:, 2] += inverse_depth * relative[:3, 3]
    mapped: np.ndarray = pinhole.matrix(other.intrinsics) @ motion @ np.linalg.inv(pinhole.matrix(reference.intrinsics))
    return mapped


def _warp(image: np.ndarray, map_to: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture as the reference would see it, -1 where it is outside."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped: np.ndarray = cv2.warpPerspective(image, map_to, size, flags=flags, borderValue=-1e4)
    return warped


@dataclass(frozen=True, eq=False)
class _Window:
    """A picture, and mean and inverse deviation of the window around each pixel."""

    image: np.ndarray
    mean: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray, window: int) -> _Window:
        mean = box(image, window)
        variance = np.maximum(box(cv2.multiply(image, image), window) - mean * mean, 0)
        return cls(image, mean, 1.0 / np.sqrt(variance + NOISE**2))

    def correlation(self, other: _Window, window: int) -> np.ndarray:
        product: np.ndarray = box(cv2.multiply(self.image, other.image), window)
        return (product - self.mean * other.mean) * (self.scale * other.scale)


def box(image: np.ndarray, window: int) -> np.ndarray:
    """The mean of the `window` x `window` pixels around each."""
    mean: np.ndarray = cv2.boxFilter(image, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REFLECT_101)
    return mean
