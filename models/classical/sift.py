"""Point matches by SIFT (Lowe 2004), RootSIFT distances (Arandjelovic and Zisserman 2012) and MAGSAC++."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from vggtgeo.models.checks import check_fields, check_image
from vggtgeo.models.classical.key_points import spread
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors, PixelMatcher
from vggtgeo.models.roles import Features


@dataclass(frozen=True)
class SiftMatcher(PixelMatcher):
    """SIFT key points spread over the image, mutual RootSIFT matches, verified epipolar geometry.

    contrast: detection threshold; a smaller one finds more and fainter points. area: maximum number of pixels for
    detection; larger images are reduced, and the refinement at full resolution makes up for it (640 x 480: half the
    time for the same trajectory error). Other fields: `PixelMatcher`.
    """

    ratio: float = 0.85
    contrast: float = 0.005
    area: int = 172_800

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, area="[10000, inf)")

    @cached_property
    def _sift(self) -> cv2.SIFT:
        # The precise upscale removes the quarter-pixel shift that the doubled first octave brings in.
        return cv2.SIFT_create(contrastThreshold=self.contrast, enable_precise_upscale=True)

    def describe(self, image: np.ndarray) -> Features:
        """Return key points and RootSIFT vectors of `image` (uint8 [H, W, 3]); none on a blank image."""
        check_image("image", image)
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        small, ratio = _shrunk(gray, self.area)
        points, vectors = self._sift.detectAndCompute(small, None)
        # Pixel centres, not corners, are integers: hence the halves.
        pixels = (np.array([p.pt for p in points], dtype=np.float64).reshape(-1, 2) + 0.5) * ratio - 0.5
        scores = np.array([p.response for p in points], dtype=np.float64)
        keep = spread(pixels, scores, self.count, gray.shape[::-1])
        vectors = np.zeros((0, 128), np.float32) if vectors is None else vectors[keep]
        return Features(pixels[keep], scores[keep], PixelDescriptors(_root(vectors), gray))


def _root(vectors: np.ndarray) -> np.ndarray:
    """RootSIFT: the square root of L1-normalised histograms has unit length and compares by Hellinger's kernel."""
    total = np.maximum(vectors.sum(axis=1, keepdims=True), 1e-7)
    return np.sqrt(vectors / total)


def _shrunk(gray: np.ndarray, area: int) -> tuple[np.ndarray, np.ndarray]:
    """`gray` with at most about `area` pixels, and how many of its own pixels a new one spans, float [2] (x, y)."""
    scale = np.sqrt(area / gray.size)
    if scale >= 1.0:
        return gray, np.ones(2)
    size = tuple(max(round(side * scale), 1) for side in gray.shape[::-1])
    return cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.array(gray.shape[::-1]) / size
