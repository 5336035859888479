"""A sequence seen through a lens that distorts."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from vggtgeo.datasets import Frame
from vggtgeo.geometry.camera import Camera


class Bent:
    """A simulated sequence as a lens draws it, whose camera nobody knows."""

    def __init__(self, source: Any, lens: Camera) -> None:
        self.source, self.name, self.has_depth, self.lens = source, source.name, False, lens
        self.camera = Camera.guess(self.lens.width, self.lens.height)

    def __len__(self) -> int:
        return len(self.source)

    def ground_truth(self) -> Any:
        return self.source.ground_truth()

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Any:
        y, x = np.mgrid[: self.lens.height, : self.lens.width].astype(np.float64)
        u, v = self.lens.undistorted(np.stack([x, y], -1)).astype(np.float32).transpose(2, 0, 1)
        for frame in self.source.frames(start, end, stride):
            image = cv2.remap(frame.image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            yield Frame(frame.index, frame.timestamp, image, None, frame.name)
