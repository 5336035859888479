"""Point matches by SIFT (Lowe 2004), RootSIFT distances (Arandjelovic and Zisserman 2012) and MAGSAC++."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from vggtgeo.models.checks import check_image
from vggtgeo.models.classical.key_points import spread
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors, match_pixels
from vggtgeo.models.classical.sub_pixel import PatchAlignment
from vggtgeo.models.classical.verification import EpipolarVerifier
from vggtgeo.models.roles import Features, PointMatches


@dataclass(frozen=True)
class SiftMatcher:
    """SIFT key points spread over the image, mutual RootSIFT matches, verified epipolar geometry.

    count: most key points an image. contrast: detection threshold, smaller finds more (and fainter) points: 0.005 finds
    twice the right matches on white walls, and takes nothing elsewhere.
    ratio: largest ratio of the best to the second-best descriptor distance. radius: how far from its predicted
    place a match may lie, pixels, where a prediction is given. area: an image of more pixels is shrunk to about so
    many for detection, which bounds the cost; the refinement works at full resolution and makes up for it (at 640 x 480
    almost half the time for the same trajectory error). refinement: sub-pixel alignment of the targets, or None.
    """

    count: int = 1500
    contrast: float = 0.005
    ratio: float = 0.85
    radius: float = 60.0
    verifier: EpipolarVerifier = field(default_factory=EpipolarVerifier)
    area: int = 172_800
    refinement: PatchAlignment | None = field(default_factory=PatchAlignment)

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"`count` is {self.count}, expected at least 1 key point an image")
        if not 0 < self.ratio <= 1:
            raise ValueError(f"`ratio` is {self.ratio}, expected a value in (0, 1]; 0.85 is usual")
        if self.area < 10_000:
            raise ValueError(f"`area` is {self.area}, expected at least 10000 pixels; 172800 is usual")

    @cached_property
    def _sift(self) -> cv2.SIFT:
        # The precise upscale removes the quarter-pixel shift that the doubled first octave brings in.
        return cv2.SIFT_create(contrastThreshold=self.contrast, enable_precise_upscale=True)

    def describe(self, image: np.ndarray) -> Features:
        """Key points and RootSIFT vectors of `image` (uint8 [H, W, 3]); none on a blank image."""
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

    def match(self, features_i: Features, features_j: Features, predicted: np.ndarray | None = None) -> PointMatches:
        """Verified matches from view i to view j; see `PointMatcher.match`."""
        return match_pixels(features_i, features_j, self.ratio, self.verifier, self.refinement, predicted, self.radius)


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
