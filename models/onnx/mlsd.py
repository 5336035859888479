"""M-LSD tiny (Gu et al., AAAI 2022) as a line detector: maps of segment centres and displacements of ends."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from vggtgeo.models.checks import check_image
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.contracts import MLSD
from vggtgeo.models.onnx.segments import tidy
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.roles import Segments

_SIDE = 512
_MAP = 256


@dataclass(frozen=True, eq=False)
class MlsdDetector:
    """A `LineDetector`. The image is stretched to 512 x 512, as in training.

    score: minimum value of a centre, in [0, 1]. least_length: minimum length in the 256 x 256 map, pixels. shortest:
    minimum length in the image, pixels. count: maximum number of segments.
    """

    session: Session
    cache: OutputCache = field(default_factory=MemoryCache)
    score: float = 0.10
    least_length: float = 20.0
    shortest: float = 20.0
    count: int = 200

    def detect(self, image: np.ndarray) -> Segments:
        """Return segments of `image` (uint8 [H, W, 3]), best first."""
        check_image("image", image)
        outputs = self.cache.get((self.session,), ("lines",), (image,), lambda: self._run(image))
        ends, scores = decode_maps(outputs["maps"], self.score, self.least_length, self.count)
        # A pixel k of the map is the pixel 2 k of the input; the input is stretched by its edges, not its centres.
        stretch = np.array(image.shape[1::-1], np.float64) / _SIDE
        return tidy(image, (2.0 * ends + 0.5) * stretch - 0.5, scores, self.shortest, self.count)

    def _run(self, image: np.ndarray) -> Outputs:
        maps = self.session.run({"image": prepare(image)[None]})["maps"]
        return {"maps": maps[0, :5]}


def prepare(image: np.ndarray) -> np.ndarray:
    """Return the network's input, float32 [4, 512, 512], of `image` (uint8 [H, W, 3])."""
    colours = MLSD.normalisation.apply(cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA))
    return np.concatenate([colours, np.full((1, _SIDE, _SIDE), 1.0 / 127.5 - 1.0, np.float32)])


def decode_maps(maps: np.ndarray, score: float, least_length: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """End points float64 [L, 2, 2] in pixels of the map, and scores float64 [L], best first.

    maps: float [5, 256, 256], logit of a centre, displacements of both ends. Of the `count` strongest centres that
    are greatest among their 3 x 3 neighbours, those above `score` and longer than `least_length` are segments.
    """
    heat = 1.0 / (1.0 + np.exp(-np.clip(maps[0].astype(np.float64), -700.0, 700.0)))
    peak = heat == cv2.dilate(heat, np.ones((3, 3), np.uint8))
    flat = np.where(peak, heat, 0.0).ravel()
    order = np.argsort(-flat, kind="stable")[:count]
    y, x = np.divmod(order, _MAP)
    ends = np.stack([x, y], axis=1)[:, None, :] + maps[1:5, y, x].T.astype(np.float64).reshape(-1, 2, 2)
    keep = (flat[order] > score) & (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > least_length)
    return ends[keep], flat[order][keep]
