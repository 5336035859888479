"""Simulated MASt3R: true reprojections with noise, gaps and outliers that gather on weak texture and glass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from vggtgeo.models.roles import Features, PointMatches
from vggtgeo.models.stubs.oracle import Oracle
from vggtgeo.models.stubs.random_fields import at_pixels, check_settings, stream, weakness


@dataclass(frozen=True)
class SimulatedMast3r:
    """Error model, with w in [0, 1] the lack of texture at the key point and g = 1 behind glass, else 0.

    Key points: `count` a frame, drawn with weight spread + strength of texture. A key point that is seen in the other
    view is missed with probability missed (1 + 3 w). A match that is made is an outlier with probability
    outliers (1 + 9 w) + behind_glass g: its target lies `outlier_shift` pixels off (deviation of a normal). Other
    targets have normal noise of noise (1 + w) pixels an axis. Of key points that are not seen in the other view a
    share `imagined` is matched all the same, as an outlier. Confidence = clip(1 - 0.7 w - 0.3 outlier + 0.1 normal):
    it knows weak texture well and outliers a little.
    """

    simulated: ClassVar[bool] = True

    oracle: Oracle
    seed: int = 0
    count: int = 1500
    spread: float = 0.10
    noise: float = 0.5
    missed: float = 0.10
    outliers: float = 0.02
    behind_glass: float = 0.35
    outlier_shift: float = 25.0
    imagined: float = 0.02

    def __post_init__(self) -> None:
        check_settings(
            self, count=1, spread=1e-6, noise=0, missed=0, outliers=0, behind_glass=0, outlier_shift=0, imagined=0
        )

    def describe(self, image: np.ndarray) -> Features:
        """Simulated key points of `image`; the descriptor is the frame's number."""
        index = self.oracle.index_of(image)
        rng = stream(self.seed, "mast3r", index)
        texture = self.oracle.texture(index)[::2, ::2]
        weight = self.spread + texture.ravel()
        chosen = np.argsort(rng.exponential(size=weight.size) / weight)[: self.count]
        rows, columns = np.divmod(chosen, texture.shape[1])
        pixels = 2.0 * np.stack([columns, rows], axis=1) + rng.uniform(-0.5, 0.5, (len(chosen), 2))
        height, width = image.shape[:2]
        return Features(np.clip(pixels, 0, [width - 1, height - 1]), texture.ravel()[chosen], index)

    def match(self, features_i: Features, features_j: Features, predicted: np.ndarray | None = None) -> PointMatches:
        """Simulated matches from view i to view j; `index_j` is -1: targets are no key points."""
        index_i, index_j = int(features_i.descriptors), int(features_j.descriptors)
        rng = stream(self.seed, "mast3r", index_i, index_j)
        pixels = features_i.pixels
        target, seen = self.oracle.correspond(index_i, index_j, pixels)
        weak = at_pixels(weakness(self.oracle, index_i), pixels)
        glass = at_pixels(self.oracle.glass(index_i), pixels)
        draw = rng.uniform(size=(3, len(pixels)))
        made = np.where(seen, draw[0] >= self.missed * (1 + 3 * weak), draw[0] < self.imagined)
        wrong = ~seen | (draw[1] < self.outliers * (1 + 9 * weak) + self.behind_glass * glass)
        blur = self.noise * (1 + weak[:, None]) * rng.standard_normal(pixels.shape)
        height, width = self.oracle.depth(index_j).shape
        anywhere = rng.uniform(size=pixels.shape) * [width - 1, height - 1]
        start = np.where(seen[:, None], target, anywhere)
        answer = start + np.where(wrong[:, None], self.outlier_shift * rng.standard_normal(pixels.shape), blur)
        made &= np.all((answer >= 0) & (answer <= [width - 1, height - 1]), axis=1)
        confidence = np.clip(1 - 0.7 * weak - 0.3 * wrong + 0.1 * rng.standard_normal(len(pixels)), 0, 1)
        rows = np.nonzero(made)[0]
        return PointMatches(rows, np.full(len(rows), -1), pixels[rows], answer[rows], confidence[rows])
