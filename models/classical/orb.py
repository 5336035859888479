"""Point matches by ORB (Rublee et al. 2011): an order of magnitude faster than SIFT, less exact."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from vggtgeo.models.checks import check_image
from vggtgeo.models.classical.key_points import spread
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors, PixelMatcher
from vggtgeo.models.roles import Features


@dataclass(frozen=True)
class OrbMatcher(PixelMatcher):
    """ORB key points spread over the image, mutual Hamming matches, verified epipolar geometry.

    ratio: maximum ratio of the square roots of the best and the second-best Hamming distance. Other fields:
    `PixelMatcher`.
    """

    @cached_property
    def _orb(self) -> cv2.ORB:
        # Twice the points, so that `spread` has a choice.
        return cv2.ORB_create(nfeatures=2 * self.count, fastThreshold=10)

    def describe(self, image: np.ndarray) -> Features:
        """Return key points and binary vectors of `image` (uint8 [H, W, 3]); none on a blank image."""
        check_image("image", image)
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        points, bits = self._orb.detectAndCompute(gray, None)
        pixels = np.array([p.pt for p in points], dtype=np.float64).reshape(-1, 2)
        scores = np.array([p.response for p in points], dtype=np.float64)
        keep = spread(pixels, scores, self.count, gray.shape[::-1])
        bits = np.zeros((0, 32), np.uint8) if bits is None else bits[keep]
        return Features(pixels[keep], scores[keep], PixelDescriptors(_signs(bits), gray))


def _signs(bits: np.ndarray) -> np.ndarray:
    """256 bits as a unit vector of signs, so that an inner product s is a Hamming distance: 128 (1 - s)."""
    return (np.unpackbits(bits, axis=1).astype(np.float32) * 2.0 - 1.0) / 16.0
