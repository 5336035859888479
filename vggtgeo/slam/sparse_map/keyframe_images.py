"""The images of a keyframe, compressed in memory after it has left the window.

At 640 x 480 the colour image and the three images of depth take 2.4 MB, compressed 0.3 MB: colours as JPEG of quality
95 59 to 75 kB (1 ms to read; the loss is below the noise of a camera, and colours of an old keyframe are used for
coarse alignment and the map only), depth and its deviation as PNG, without loss, 70 to 177 kB each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import cv2
import numpy as np

JPEG = (".jpg", (cv2.IMWRITE_JPEG_QUALITY, 95))
PNG = (".png", (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP))
"""One filter for all rows: choosing it row by row takes a third of the time and makes these files no smaller."""


@dataclass(frozen=True, eq=False)
class CompressedImage:
    """An encoded image. shape, dtype: those of the array."""

    data: bytes
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @classmethod
    def of(cls, image: np.ndarray) -> Self:
        """Encode uint8 [H, W, 3] as JPEG, else uint8 or float16 [H, W] as PNG, bit by bit."""
        kind, options = JPEG if image.ndim == 3 else PNG
        bits = image.view(np.uint16) if image.dtype == np.float16 else image
        _, data = cv2.imencode(kind, np.ascontiguousarray(bits), options)
        return cls(data.tobytes(), image.shape, image.dtype)

    def array(self) -> np.ndarray:
        """Return the decoded image."""
        # Colours are as they were given: encoded and decoded without a change of their order.
        image = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_UNCHANGED)
        return image.view(self.dtype).reshape(self.shape)


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """Images of a keyframe.

    colour: uint8 [H, W, 3] RGB. depth: float16 [H, W] metres, NaN = unknown (its rounding, 0.5 mm at 1 m, is below the
    noise of any sensor). depth_sigma: float16 [H, W], its relative standard deviation as stated by the role.
    depth_confidence: uint8 [H, W], 255 is 1.
    """

    colour: np.ndarray | CompressedImage
    depth: np.ndarray | CompressedImage
    depth_sigma: np.ndarray | CompressedImage
    depth_confidence: np.ndarray | CompressedImage

    @property
    def small(self) -> bool:
        """Whether they are compressed."""
        return isinstance(self.colour, CompressedImage)

    @cached_property
    def has_depth(self) -> bool:
        """Whether any pixel has a depth; decoded once for that."""
        return bool(np.isfinite(array_of(self.depth)).any())

    def compressed(self) -> KeyframeImages:
        """Return the images compressed; each access decodes one."""
        return KeyframeImages(*(CompressedImage.of(array_of(image)) for image in self._every()))

    def expanded(self) -> KeyframeImages:
        """Return the images as arrays."""
        return KeyframeImages(*(array_of(image) for image in self._every()))

    def _every(self) -> tuple[np.ndarray | CompressedImage, ...]:
        return self.colour, self.depth, self.depth_sigma, self.depth_confidence


def array_of(image: np.ndarray | CompressedImage) -> np.ndarray:
    """Return the image as an array."""
    return image if isinstance(image, np.ndarray) else image.array()
