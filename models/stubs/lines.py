"""Simulated LETR: the scene's visible edges with noise at their ends, missed edges, and false segments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from vggtgeo.models.roles import Segments
from vggtgeo.models.stubs.oracle import Oracle
from vggtgeo.models.stubs.random_fields import check_settings, stream


@dataclass(frozen=True)
class SimulatedLetr:
    """Error model: an edge of contrast c (grey levels a pixel) is found with probability found c / (c + half).

    across, along: deviation of each end across and along its segment, pixels. false: mean number of false segments a
    frame (Poisson). shortest: pixels; shorter segments are not found. Scores are uniform in [0.7, 1] for true and in
    [0.7, 0.85] for false ones (LETR's own threshold is 0.7), so that a score tells a little and no more.
    """

    simulated: ClassVar[bool] = True

    oracle: Oracle
    seed: int = 0
    across: float = 0.7
    along: float = 3.0
    found: float = 0.9
    half: float = 2.0
    false: float = 6.0
    shortest: float = 20.0

    def __post_init__(self) -> None:
        check_settings(self, across=0, along=0, found=0, half=0, false=0, shortest=0)

    def detect(self, image: np.ndarray) -> Segments:
        """Simulated segments of `image`, best first."""
        index = self.oracle.index_of(image)
        rng = stream(self.seed, "letr", index)
        edges = self.oracle.edges(index)
        ends = np.asarray(edges.pixels, float).reshape(-1, 2, 2)
        contrast = np.asarray(edges.contrast)
        chance = self.found * contrast / (contrast + self.half + 1e-12)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        kept = (rng.uniform(size=len(ends)) < chance) & (length >= self.shortest)
        true = _noisy(ends[kept], self.across, self.along, rng)
        false = self._false_segments(image.shape[1], image.shape[0], rng)
        scores = np.concatenate([rng.uniform(0.7, 1.0, len(true)), rng.uniform(0.7, 0.85, len(false))])
        order = np.argsort(-scores, kind="stable")
        return Segments(np.concatenate([true, false])[order], scores[order])

    def _false_segments(self, width: int, height: int, rng: np.random.Generator) -> np.ndarray:
        count = int(rng.poisson(self.false))
        middle = rng.uniform(0, 1, (count, 2)) * [width - 1, height - 1]
        angle = rng.uniform(0, np.pi, count)
        half = 0.5 * rng.uniform(max(self.shortest, 1.0), 0.25 * width, count)
        way = half[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ends = np.stack([middle - way, middle + way], axis=1)
        return np.clip(ends, 0, [width - 1, height - 1])


def _noisy(ends: np.ndarray, across: float, along: float, rng: np.random.Generator) -> np.ndarray:
    """Return segments [L, 2, 2] with independent normal errors of their ends."""
    way = ends[:, 1] - ends[:, 0]
    way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=1)
    shift = rng.standard_normal((len(ends), 2, 2))
    return ends + along * shift[..., :1] * way[:, None] + across * shift[..., 1:] * normal[:, None]
