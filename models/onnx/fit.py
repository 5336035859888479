"""Resizing of an image to a network's input, with a border for another aspect, and back."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from vggtgeo.models.classical.pixel_matcher import unit

_MAX_STRETCH = 1.05
_BORDER = (127, 127, 127)


@dataclass(frozen=True)
class Fit:
    """image pixel p -> network pixel scale (p + 1/2) - 1/2 + offset: sizes are stretched, not distances of centres.

    image_size, network_size, content_size: (height, width); the image fills `content_size` of the network's input,
    from `offset` (x, y) on, and the rest is grey.
    """

    image_size: tuple[int, int]
    network_size: tuple[int, int]
    content_size: tuple[int, int]

    @classmethod
    def of(cls, image_size: tuple[int, int], network_size: tuple[int, int]) -> Fit:
        """Return the fit: stretched if that changes the aspect by less than 5 %, else with a border."""
        (height, width), (rows, columns) = image_size, network_size
        across, down = columns / width, rows / height
        if max(across, down) <= _MAX_STRETCH * min(across, down):
            return cls(image_size, network_size, network_size)
        factor = min(across, down)
        content = max(1, min(rows, round(factor * height))), max(1, min(columns, round(factor * width)))
        return cls(image_size, network_size, content)

    @property
    def scale(self) -> np.ndarray:
        """Return float64 [2] (x, y): network pixels per image pixel."""
        return np.array(self.content_size[::-1]) / np.array(self.image_size[::-1])

    @property
    def offset(self) -> np.ndarray:
        """Return int64 [2] (x, y): where the image begins in the network's input."""
        return (np.array(self.network_size[::-1]) - np.array(self.content_size[::-1])) // 2

    def resize(self, image: np.ndarray) -> np.ndarray:
        """Return uint8 [*network_size, 3] of `image` (uint8 [*image_size, 3])."""
        shrinks = self.content_size[0] <= self.image_size[0]
        way = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
        content = cv2.resize(image, self.content_size[::-1], interpolation=way)
        if self.content_size == self.network_size:
            return content
        left, top = (int(value) for value in self.offset)
        bottom = self.network_size[0] - self.content_size[0] - top
        right = self.network_size[1] - self.content_size[1] - left
        return cv2.copyMakeBorder(content, top, bottom, left, right, cv2.BORDER_CONSTANT, value=_BORDER)

    def to_network(self, pixels: np.ndarray) -> np.ndarray:
        """Return pixels [..., 2] of the network's input for pixels of the image."""
        return self.scale * (pixels + 0.5) - 0.5 + self.offset

    def to_image(self, pixels: np.ndarray) -> np.ndarray:
        """Return pixels [..., 2] of the image for pixels of the network's input."""
        return (pixels - self.offset + 0.5) / self.scale - 0.5

    def inside(self, pixels: np.ndarray) -> np.ndarray:
        """Return which pixels float [n, 2] of the image are between its outermost pixel centres, bool [n]."""
        return np.asarray(((pixels >= 0) & (pixels <= np.array(self.image_size[::-1]) - 1)).all(axis=1))

    def map_to_image(self, values: np.ndarray) -> np.ndarray:
        """Return a map [*network_size, ...] as float32 [*image_size, ...], interpolated, without the border."""
        left, top = (int(value) for value in self.offset)
        content = values[top : top + self.content_size[0], left : left + self.content_size[1]]
        return cv2.resize(np.asarray(content, np.float32), self.image_size[::-1], interpolation=cv2.INTER_LINEAR)

    def intrinsics_to_image(self, intrinsics: np.ndarray) -> np.ndarray:
        """Return (fx, fy, cx, cy) of the image, float64 [4], from those of the network's input."""
        focal = np.asarray(intrinsics[:2], np.float64) / self.scale
        return np.concatenate([focal, self.to_image(np.asarray(intrinsics[2:], np.float64))])


def vectors_at(grid: np.ndarray, pixels: np.ndarray, network_size: tuple[int, int]) -> np.ndarray:
    """Return unit vectors float32 [n, C] of a map [h, w, C] at `pixels` [n, 2] of the network's input, interpolated
    bilinearly between the centres of the map's cells.
    """
    size = np.array(grid.shape[1::-1])
    place = np.clip(size / np.array(network_size[::-1]) * (pixels + 0.5) - 0.5, 0.0, size - 1)
    low = np.minimum(place.astype(np.int64), np.maximum(size - 2, 0))
    high = np.minimum(low + 1, size - 1)
    (x0, y0), (x1, y1), (u, v) = low.T, high.T, (place - low).astype(np.float32).T[..., None]
    above = (1 - u) * grid[y0, x0] + u * grid[y0, x1]
    below = (1 - u) * grid[y1, x0] + u * grid[y1, x1]
    return unit((1 - v) * above + v * below)


def at_multiples(size: tuple[int, int], multiple: int, width: int | None = None) -> tuple[int, int]:
    """Return (height, width) close to `size`, or of its aspect with this `width`, in multiples of `multiple`."""
    factor = 1.0 if width is None else width / size[1]
    height, width = (max(1, round(factor * side / multiple)) * multiple for side in size)
    return height, width
