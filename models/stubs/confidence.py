"""Simulated DINOv3 saliency: texture and structure of the scene, on patches, with noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from vggtgeo.models.stubs.oracle import Oracle
from vggtgeo.models.stubs.random_fields import check_settings, stream, weakness


@dataclass(frozen=True)
class SimulatedDino:
    """Error model: Omega = clip(floor + (1 - floor) (share s + (1 - share) e) + noise), made on patches of 16 px.

    s: strength of texture around the pixel, 0 to 1. e: nearness of a straight edge, exp(-distance / reach). noise:
    normal, one draw a patch, deviation `noise`. blind: factor behind glass, where attention is drawn by reflections.
    floor: least saliency. share: weight of texture against structure. reach: pixels. patch: side of a patch, pixels.
    """

    simulated: ClassVar[bool] = True

    oracle: Oracle
    seed: int = 0
    noise: float = 0.08
    floor: float = 0.10
    share: float = 0.65
    reach: float = 12.0
    blind: float = 0.7
    patch: int = 16

    def __post_init__(self) -> None:
        check_settings(self, noise=0, floor=0, share=0, reach=1e-3, blind=0, patch=1)

    def confidence(self, image: np.ndarray) -> np.ndarray:
        """Simulated Omega of `image`, float32 [H, W] in [0, 1]."""
        index = self.oracle.index_of(image)
        strength = 1.0 - weakness(self.oracle, index)
        height, width = strength.shape
        saliency = self.share * strength + (1 - self.share) * self._structure(index, (height, width))
        saliency = self.floor + (1 - self.floor) * saliency
        saliency = saliency * np.where(self.oracle.glass(index), self.blind, 1.0)
        grid = (-(-width // self.patch), -(-height // self.patch))
        coarse = cv2.resize(saliency.astype(np.float32), grid, interpolation=cv2.INTER_AREA)
        coarse += self.noise * stream(self.seed, "dino", index).standard_normal(coarse.shape, dtype=np.float32)
        smooth = cv2.resize(np.clip(coarse, 0, 1), (width, height), interpolation=cv2.INTER_LINEAR)
        return np.clip(smooth, 0.0, 1.0).astype(np.float32)

    def _structure(self, index: int, shape: tuple[int, int]) -> np.ndarray:
        canvas = np.full(shape, 255, np.uint8)
        for start, end in np.rint(self.oracle.edges(index).pixels).astype(int).tolist():
            cv2.line(canvas, tuple(start), tuple(end), 0, 1)
        distance = cv2.distanceTransform(canvas, cv2.DIST_L2, 3)
        return np.exp(-distance / self.reach)
