"""A depth map with standard deviation and confidence of every pixel."""

from __future__ import annotations

from typing import Self

import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.slam.sparse_map.keyframe_images import CompressedImage, array_of

COMPRESS_FROM = 200
"""Number of keyframes from which depth maps are compressed in memory. At 640 x 480: 0.4 MB in place of 3.7 MB, 20 ms to
compress, 4 ms to decode one of the three images."""


class DepthMap:
    """Depth, standard deviation and confidence of the pixels of an image.

    Args:
        depth: float32 [H, W], z in metres (arbitrary unit if the scale is free), NaN = unknown.
        sigma: float32 [H, W], relative standard deviation.
        confidence: float32 [H, W] in [0, 1], 0 where depth is unknown.

    Raises:
        InputError: the shapes differ, or are not [H, W].

    """

    def __init__(self, depth: np.ndarray, sigma: np.ndarray, confidence: np.ndarray) -> None:
        for name, part in (("depth", depth), ("sigma", sigma), ("confidence", confidence)):
            if part.shape != depth.shape or len(part.shape) != 2:
                raise InputError(f"`{name}` must be [H, W] as `depth` {depth.shape}, got shape {part.shape}")
        self._parts: tuple[np.ndarray | CompressedImage, ...] = (depth, sigma, confidence)
        self._unit = 1.0
        self._known: float | None = None  # share of known pixels, if compressed

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self._parts[0].shape
        return height, width

    @property
    def depth(self) -> np.ndarray:
        """float32 [H, W], NaN = unknown."""
        found = array_of(self._parts[0])
        return found if self._known is None else found.astype(np.float32) * np.float32(self._unit)

    @property
    def sigma(self) -> np.ndarray:
        """float32 [H, W], relative."""
        found = array_of(self._parts[1])
        return found if self._known is None else found.astype(np.float32)

    @property
    def confidence(self) -> np.ndarray:
        """float32 [H, W] in [0, 1]."""
        found = array_of(self._parts[2])
        return found if self._known is None else found.astype(np.float32) / np.float32(255)

    @property
    def share(self) -> float:
        """Share of pixels with known depth."""
        return float(np.isfinite(self.depth).mean()) if self._known is None else self._known

    @property
    def is_compressed(self) -> bool:
        """Whether each access decodes an image."""
        return self._known is not None

    @property
    def empty(self) -> bool:
        """Whether all depth is unknown."""
        return self.share == 0

    def __repr__(self) -> str:
        return f"DepthMap({self.shape[1]} x {self.shape[0]}, {self.share:.0%} known)"

    def compressed(self) -> Self:
        """Return a compressed copy, with depth and sigma rounded to 0.05 %; each access decodes one image."""
        if self.is_compressed or self.empty:
            return self
        small = type(self)(self.depth, self.sigma, self.confidence)
        small._known = self.share
        small._unit = float(np.nanmedian(self.depth))  # keeps the range of half precision for any scale of the map
        scaled = (self.depth / small._unit).astype(np.float16), self.sigma.astype(np.float16)
        levels = np.rint(255 * self.confidence).astype(np.uint8)
        small._parts = tuple(CompressedImage.of(image) for image in (*scaled, levels))
        return small

    def compressed_for(self, keyframes: int) -> Self:
        """Return the depth map, compressed if the map has many keyframes."""
        return self.compressed() if keyframes >= COMPRESS_FROM else self

    def decoded(self) -> Self:
        """Return the depth map with plain arrays, for repeated access."""
        return self if self._known is None else type(self)(self.depth, self.sigma, self.confidence)
