"""Line detectors: LETR (Xu et al., CVPR 2021), a set of queries, each a segment or nothing; and M-LSD tiny (Gu et al.,
AAAI 2022), maps of segment centres and displacements of ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache
from vggtgeo.models.onnx.contracts import MLSD
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.roles import Segments


def tidy(image: np.ndarray, endpoints: np.ndarray, scores: np.ndarray, shortest: float, count: int) -> Segments:
    """Return segments cut off at the border of `image` (uint8 [H, W, 3]), directed by their brighter side, best first.

    endpoints: float [L, 2, 2], pixels. scores: float [L]. The best `count` with at least `shortest` pixels inside are
    kept.
    """
    height, width = image.shape[:2]
    ends = cut_off(np.asarray(endpoints, np.float64).reshape(-1, 2, 2), (width, height))
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    order = np.argsort(-scores, kind="stable")
    order = order[length[order] >= shortest][:count]
    return Segments(directed(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), ends[order]), scores[order].astype(np.float64))


def cut_off(endpoints: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the parts of segments float64 [L, 2, 2] inside an image of `size` (width, height), along the segments
    themselves.

    Clipping x and y separately would rotate a segment. Both ends are equal for a segment outside (Liang and
    Barsky, "A new concept and method for line clipping", ACM TOG 3(1), 1984).
    """
    start, way = endpoints[:, 0], endpoints[:, 1] - endpoints[:, 0]
    low, high = np.zeros(2), np.array(size, np.float64) - 1.0
    along = np.where(way == 0, 1.0, way)
    bounds = np.stack([(low - start) / along, (high - start) / along])
    outside = (start < low) | (start > high)
    never = np.where(outside, np.inf, -np.inf)  # parallel to a side: beyond it wholly, or never cut by it
    enter = np.where(way == 0, never, bounds.min(axis=0)).max(axis=1).clip(min=0.0)
    leave = np.where(way == 0, -never, bounds.max(axis=0)).min(axis=1).clip(max=1.0)
    empty = enter >= leave
    enter, leave = np.where(empty, 0.0, enter), np.where(empty, 0.0, leave)
    return np.stack([start + enter[:, None] * way, start + leave[:, None] * way], axis=1)


def directed(gray: np.ndarray, endpoints: np.ndarray) -> np.ndarray:
    """Return `endpoints` [L, 2, 2] with ends swapped so that the brighter side is on the left, as LSD has it.

    gray: uint8 [H, W]. The sides are compared 3 pixels from the segment; left is as seen in the image from end 0
    to end 1. Line descriptors and gates compare directions, which are arbitrary in networks.
    """
    if not len(endpoints):
        return endpoints
    along = endpoints[:, 1] - endpoints[:, 0]
    right = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    place = np.linspace(0.1, 0.9, 16)[:, None]
    middle = endpoints[:, None, 0] + place * along[:, None]
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.0).astype(np.float32)
    sides = [_read(smooth, middle + reach * right[:, None]).mean(axis=1) for reach in (3.0, -3.0)]
    swap = sides[0] > sides[1]
    return np.where(swap[:, None, None], endpoints[:, ::-1], endpoints)


def _read(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    x, y = pixels.astype(np.float32).transpose(2, 0, 1)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


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
        factor = SHORT_SIDE / min(image.shape[:2])
        height, width = (round(factor * side) for side in image.shape[:2])
        fit = self.session.fit(image, (height, width))
        run = lambda: self.session.run({"image": self.session.prepare(image, fit)})
        outputs = self.cache.get((self.session,), ("lines",), (image,), run)
        ends, scores = decode_lines(outputs["pred_logits"][0], outputs["pred_lines"][0], fit.network_size)
        size = np.array(fit.network_size[::-1], np.float64)
        # Segments may end slightly outside the image; those a whole image away are invalid.
        near = ((ends > -size) & (ends < 2 * size)).all(axis=(1, 2))
        keep = near & (scores >= self.score)
        return tidy(image, fit.to_image(ends[keep]), scores[keep], self.shortest, self.count)


def decode_lines(logits: np.ndarray, lines: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """End points float64 [Q, 2, 2] in pixels of the network's input of `size` (H, W), and probabilities float64 [Q].

    logits: float [Q, 2], of a segment and of nothing. lines: float [Q, 4], x0 y0 x1 y1; 0 and 1 are the outer edges
    of the image, half a pixel beyond the centres of its outermost pixels.
    """
    ends = lines.astype(np.float64).reshape(-1, 2, 2) * np.array(size[::-1], np.float64) - 0.5
    gap = logits[:, 1].astype(np.float64) - logits[:, 0]
    return ends, 1.0 / (1.0 + np.exp(np.clip(gap, -700.0, 700.0)))


_SIDE = 512
_MAP = 256


@dataclass(frozen=True, eq=False)
class MlsdDetector:
    """A `LineDetector`. The image is stretched to 512 x 512, as in training.

    score: minimum value of a centre, in [0, 1]. min_length: minimum length in the 256 x 256 map, pixels. shortest:
    minimum length in the image, pixels. count: maximum number of segments.
    """

    session: Session
    cache: OutputCache = field(default_factory=MemoryCache)
    score: float = 0.10
    min_length: float = 20.0
    shortest: float = 20.0
    count: int = 200

    def detect(self, image: np.ndarray) -> Segments:
        run = lambda: {"maps": self.session.run({"image": prepare(image)[None]})["maps"][0, :5]}
        outputs = self.cache.get((self.session,), ("lines",), (image,), run)
        ends, scores = decode_maps(outputs["maps"], self.score, self.min_length, self.count)
        # A pixel k of the map is the pixel 2 k of the input; the input is stretched by its edges, not its centres.
        stretch = np.array(image.shape[1::-1], np.float64) / _SIDE
        return tidy(image, (2.0 * ends + 0.5) * stretch - 0.5, scores, self.shortest, self.count)


def prepare(image: np.ndarray) -> np.ndarray:
    """Return the network's input, float32 [4, 512, 512], of `image` (uint8 [H, W, 3])."""
    colours = MLSD.normalisation.apply(cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA))
    return np.concatenate([colours, np.full((1, _SIDE, _SIDE), 1.0 / 127.5 - 1.0, np.float32)])


def decode_maps(maps: np.ndarray, score: float, min_length: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """End points float64 [L, 2, 2] in pixels of the map, and scores float64 [L], best first.

    maps: float [5, 256, 256], logit of a centre, displacements of both ends. Of the `count` strongest centres that
    are greatest among their 3 x 3 neighbours, those above `score` and longer than `min_length` are segments.
    """
    heat = 1.0 / (1.0 + np.exp(-np.clip(maps[0].astype(np.float64), -700.0, 700.0)))
    peak = heat == cv2.dilate(heat, np.ones((3, 3), np.uint8))
    flat = np.where(peak, heat, 0.0).ravel()
    order = np.argsort(-flat, kind="stable")[:count]
    y, x = np.divmod(order, _MAP)
    ends = np.stack([x, y], axis=1)[:, None, :] + maps[1:5, y, x].T.astype(np.float64).reshape(-1, 2, 2)
    keep = (flat[order] > score) & (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > min_length)
    return ends[keep], flat[order][keep]
