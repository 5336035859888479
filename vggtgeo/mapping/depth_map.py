"""Depth of every pixel of a keyframe, and how far it can be trusted."""

from __future__ import annotations

from typing import Self

import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.slam.sparse_map.keyframe_images import CompressedImage, array_of

MANY = 200
"""Keyframes of a map from which on its depth maps are held compressed: at 640 x 480 one takes 3.7 MB, and 0.4 so, after
20 ms; each look at one of its three parts then takes 4 ms."""


class DepthMap:
    """What is known of a picture's depth, pixel by pixel.

    Args:
        depth: float32 [H, W], z in metres (in the map's own unit where the scale is free), NaN = none.
        sigma: float32 [H, W], its relative standard deviation.
        confidence: float32 [H, W] in [0, 1], 0 where there is no depth.

    Raises:
        InputError: they are not of one shape.

    """

    def __init__(self, depth: np.ndarray, sigma: np.ndarray, confidence: np.ndarray) -> None:
        for name, part in (("depth", depth), ("sigma", sigma), ("confidence", confidence)):
            if part.shape != depth.shape or len(part.shape) != 2:
                raise InputError(f"`{name}` has shape {part.shape}; it must be [H, W], as `depth` {depth.shape}")
        self._parts: tuple[np.ndarray | CompressedImage, ...] = (depth, sigma, confidence)
        self._unit = 1.0
        self._known: float | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self._parts[0].shape
        return height, width

    @property
    def depth(self) -> np.ndarray:
        """float32 [H, W], NaN = none."""
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
        """Of the pixels that have a depth."""
        return float(np.isfinite(self.depth).mean()) if self._known is None else self._known

    @property
    def is_compressed(self) -> bool:
        """Whether each look decodes an image."""
        return self._known is not None

    @property
    def empty(self) -> bool:
        """Whether no pixel has a depth."""
        return self.share == 0

    def __repr__(self) -> str:
        return f"DepthMap({self.shape[1]} x {self.shape[0]}, {self.share:.0%} known)"

    def compressed(self) -> Self:
        """The same in little memory, depth and its deviation to 0.05 %; each look at one of the three decodes it."""
        if self.is_compressed or self.empty:
            return self
        small = type(self)(self.depth, self.sigma, self.confidence)
        small._known = self.share
        small._unit = float(np.nanmedian(self.depth))  # of half precision, whatever the map's own unit is
        scaled = (self.depth / small._unit).astype(np.float16), self.sigma.astype(np.float16)
        shades = np.rint(255 * self.confidence).astype(np.uint8)
        small._parts = tuple(CompressedImage.of(image) for image in (*scaled, shades))
        return small

    def held_by(self, keyframes: int) -> Self:
        """As a map of so many keyframes holds it."""
        return self.compressed() if keyframes >= MANY else self

    def opened(self) -> Self:
        """The same as arrays, for several looks."""
        return self if self._known is None else type(self)(self.depth, self.sigma, self.confidence)
