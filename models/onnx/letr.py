"""LETR (Xu et al., CVPR 2021) as a line detector: a set of queries, each a segment or nothing."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from vggtgeo.models.checks import check_image
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.contracts import LETR
from vggtgeo.models.onnx.fit import Fit
from vggtgeo.models.onnx.segments import tidy
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.roles import Segments

SHORT_SIDE = 512
"""Pixels of the shorter side where the file leaves the size open."""


@dataclass(frozen=True, eq=False)
class LetrDetector:
    """A `LineDetector`. score: minimum probability; shortest: minimum length, pixels; count: maximum number."""

    session: Session
    cache: OutputCache = field(default_factory=MemoryCache)
    score: float = 0.7
    shortest: float = 20.0
    count: int = 200

    def detect(self, image: np.ndarray) -> Segments:
        """Return segments of `image` (uint8 [H, W, 3]), most probable first."""
        check_image("image", image)
        factor = SHORT_SIDE / min(image.shape[:2])
        wanted = tuple(round(factor * side) for side in image.shape[:2])
        rows, columns = self.session.inputs["image"].shape[2:]
        fit = Fit.of(image.shape[:2], (rows or wanted[0], columns or wanted[1]))
        outputs = self.cache.get((self.session,), ("lines",), (image,), lambda: self._run(image, fit))
        ends, scores = decode_lines(outputs["pred_logits"][0], outputs["pred_lines"][0], fit.network_size)
        size = np.array(fit.network_size[::-1], np.float64)
        # Segments may end slightly outside the image; those a whole image away are invalid.
        near = ((ends > -size) & (ends < 2 * size)).all(axis=(1, 2))
        keep = near & (scores >= self.score)
        return tidy(image, fit.to_image(ends[keep]), scores[keep], self.shortest, self.count)

    def _run(self, image: np.ndarray, fit: Fit) -> Outputs:
        return self.session.run({"image": LETR.normalisation.apply(fit.resize(image))[None]})


def decode_lines(logits: np.ndarray, lines: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """End points float64 [Q, 2, 2] in pixels of the network's input of `size` (H, W), and probabilities float64 [Q].

    logits: float [Q, 2], of a segment and of nothing. lines: float [Q, 4], x0 y0 x1 y1; 0 and 1 are the outer edges
    of the image, half a pixel beyond the centres of its outermost pixels.
    """
    ends = lines.astype(np.float64).reshape(-1, 2, 2) * np.array(size[::-1], np.float64) - 0.5
    gap = logits[:, 1].astype(np.float64) - logits[:, 0]
    return ends, 1.0 / (1.0 + np.exp(np.clip(gap, -700.0, 700.0)))
