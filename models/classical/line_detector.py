"""Line segments by LSD (Grompone von Gioi et al. 2010)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from vggtgeo.models.checks import check_fields, check_image
from vggtgeo.models.roles import Segments

_SCALE = 0.8
# LSD shrinks the image by `_SCALE` with pixel centres aligned at the corner, and maps back without that half pixel.
_SHIFT = 0.5 / _SCALE - 0.5


@dataclass(frozen=True)
class LsdDetector:
    """OpenCV's LSD, with short segments dropped and the longest kept; a segment's score is its length in pixels.

    The ends are ordered so that the brighter side is always the same one: a segment has a direction.

    shortest: least length, pixels. count: most segments an image.
    """

    shortest: float = 30.0
    count: int = 200

    def __post_init__(self) -> None:
        check_fields(self, shortest="(0, inf)", count="[0, inf)")

    def detect(self, image: np.ndarray) -> Segments:
        """Return segments of `image` (uint8 [H, W, 3]), longest first; none on a blank image."""
        check_image("image", image)
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        # The detector is made anew for each image: it holds buffers, and making it costs microseconds.
        found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, _SCALE).detect(gray)[0]
        # OpenCV 4 gives [L, 1, 4], OpenCV 5 [L, 4], and both None when there is nothing.
        ends = np.zeros((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64) + _SHIFT
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        order = np.argsort(-length, kind="stable")
        order = order[length[order] >= self.shortest][: self.count]
        return Segments(ends[order], length[order])
