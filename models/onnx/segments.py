"""Post-processing of line segments of networks."""

from __future__ import annotations

import cv2
import numpy as np
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


def directed(gray: np.ndarray, endpoints: np.ndarray, samples: int = 16, reach: float = 3.0) -> np.ndarray:
    """Return `endpoints` [L, 2, 2] with ends swapped so that the brighter side is on the left, as LSD has it.

    gray: uint8 [H, W]. The sides are compared `reach` pixels from the segment; left is as seen in the image from end 0
    to end 1. Line descriptors and gates compare directions, which are arbitrary in networks.
    """
    if not len(endpoints):
        return endpoints
    along = endpoints[:, 1] - endpoints[:, 0]
    right = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    place = np.linspace(0.1, 0.9, samples)[:, None]
    middle = endpoints[:, None, 0] + place * along[:, None]
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.0).astype(np.float32)
    sides = [_read(smooth, middle + sign * reach * right[:, None]).mean(axis=1) for sign in (1.0, -1.0)]
    swap = sides[0] > sides[1]
    return np.where(swap[:, None, None], endpoints[:, ::-1], endpoints)


def _read(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    x, y = pixels.astype(np.float32).transpose(2, 0, 1)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
