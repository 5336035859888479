"""ALIKE (Zhao et al., IEEE Transactions on Multimedia 2022) and XFeat (Potje et al., CVPR 2024) as point matchers.

Both return maps of an image: a score per pixel, and descriptors per pixel or per 8 x 8 block. Key points and their
vectors are extracted from the maps here, and matched as those of SIFT.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors, PixelMatcher, spread
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.fit import vectors_at
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.roles import Features

_RADIUS = 2
"""Radius of non-maximum suppression, pixels, as published for both networks."""


@dataclass(frozen=True, eq=False)
class DensePointMatcher(PixelMatcher):
    """A `PointMatcher`. Key points: the local maxima of the score map, to a fraction of a pixel, spread over the image.

    score: minimum score, in [0, 1]; the authors use 0.2 (ALIKE) and 0.05 (XFeat), and less keeps faint points of white
    walls. Other fields: `PixelMatcher`.
    """

    session: Session = field(kw_only=True)
    cache: OutputCache = field(default_factory=MemoryCache)
    score: float = 0.02

    def describe(self, image: np.ndarray) -> Features:
        """Return key points and unit vectors of `image` (uint8 [H, W, 3]); none where no score is high enough."""
        settings = ("key points", self.count, self.score)
        found = self.cache.get((self.session,), settings, (image,), lambda: self._run(image))
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        return Features(found["pixels"], found["scores"], PixelDescriptors(found["vectors"], gray))

    def _run(self, image: np.ndarray) -> Outputs:
        fit = self.session.fit(image)
        scores, descriptors = (tensor.name for tensor in self.session.contract.outputs)
        maps = self.session.run({"image": self.session.prepare(image, fit)})
        places, strength = peaks(maps[scores][0, 0], self.score)
        pixels = fit.to_image(places)
        inside = np.flatnonzero(fit.inside(pixels))
        keep = inside[spread(pixels[inside], strength[inside], self.count, image.shape[1::-1])]
        vectors = vectors_at(maps[descriptors][0].transpose(1, 2, 0), places[keep], fit.network_size)
        return {"pixels": pixels[keep], "scores": strength[keep], "vectors": vectors}


def peaks(scores: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return local maxima of a map float [H, W] above `least`: float64 [M, 2] (x, y), and their values float64 [M].

    The place between pixels is the top of the parabolas through a maximum and its neighbours in each direction; where
    there is none, on a plateau or along a ridge, is no key point.
    """
    values = np.asarray(scores, np.float32)
    side = 2 * _RADIUS + 1
    highest = (values == cv2.dilate(values, np.ones((side, side), np.uint8))) & (values > least)
    inner = np.zeros_like(highest)
    inner[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS] = True
    y, x = np.nonzero(highest & inner)
    top = values[y, x].astype(np.float64)
    before = np.stack([values[y, x - 1], values[y - 1, x]], axis=1)
    after = np.stack([values[y, x + 1], values[y + 1, x]], axis=1)
    bend = 2.0 * top[:, None] - before - after
    good = (bend > 0).all(axis=1)
    step = 0.5 * (after - before)[good] / bend[good]  # within half a pixel, as the middle one is highest
    return np.stack([x, y], axis=1)[good] + step, top[good]
