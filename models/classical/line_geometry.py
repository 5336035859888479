"""Segments as geometry: line coefficients, samples along a segment, depth at its ends."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
from vggtgeo.models.checks import check_array


def line_coefficients(endpoints: np.ndarray) -> np.ndarray:
    """Return (a, b, c), float64 [L, 3], with a x + b y + c = 0 on the line and a^2 + b^2 = 1.

    endpoints: float [L, 2, 2] = (segment, end, xy). a x + b y + c is then the signed distance of a pixel, positive
    to the right of the direction from end 0 to end 1 as the image shows it. Raises `ValueError` for ends that coincide.
    """
    check_array("endpoints", endpoints, (None, 2, 2))
    start = endpoints[:, 0].astype(np.float64)
    along = endpoints[:, 1] - start
    length = np.linalg.norm(along, axis=1)
    if (length < 1e-9).any():
        raise ValueError(
            f"`endpoints` has {int((length < 1e-9).sum())} segments of no length, expected two distinct ends; drop them"
        )
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
    return np.concatenate([normal, -(normal * start).sum(axis=1, keepdims=True)], axis=1)


def sample_segments(endpoints: np.ndarray, spacing: float = 10.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels every `spacing` along segments, centred so that both ends are equally far from a sample.

    endpoints: float [L, 2, 2]. Returns index int [s], the segment of each sample; pixels float64 [s, 2]; and fraction
    float64 [s] in [0, 1], the position from end 0 to end 1. A segment of length l has floor(l / spacing) + 1.
    """
    check_array("endpoints", endpoints, (None, 2, 2))
    along = (endpoints[:, 1] - endpoints[:, 0]).astype(np.float64)
    length = np.linalg.norm(along, axis=1)
    counts = np.floor(length / spacing + 1e-9).astype(np.int64) + 1
    index = np.repeat(np.arange(len(endpoints)), counts)
    rank = np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
    margin = 0.5 * (length - (counts - 1) * spacing)
    fraction = (margin[index] + rank * spacing) / np.maximum(length[index], 1e-9)
    fraction = np.clip(fraction, 0.0, 1.0)
    return index, endpoints[index, 0] + fraction[:, None] * along[index], fraction


def segment_depths(endpoints: np.ndarray, depth: np.ndarray, tolerance: float = 0.03, least: int = 4) -> np.ndarray:
    """Return depth of both ends, float64 [L, 2] in metres, NaN where the image's depth does not show a straight edge.

    Along the image of a 3D line inverse depth is affine, so an affine function is fitted to the inverse depths under
    each segment: for every pair of samples far apart, the function through both is scored by how many samples it
    explains within `tolerance` (relative), and the best is refitted to those. An edge is the rim of what is in front,
    so each sample takes the depth of the foremost surface among its 3 x 3 pixels, and of two equal fits the nearer one
    wins.

    endpoints: float [L, 2, 2]. depth: float [H, W] metres, NaN = none. least: samples that must agree.
    """
    index, pixels, fraction = sample_segments(endpoints, 5.0)
    values = _foremost_depth(depth, pixels)
    result = np.full((len(endpoints), 2), np.nan)
    bounds = np.searchsorted(index, np.arange(len(endpoints) + 1))
    for segment, (low, high) in enumerate(pairwise(bounds)):
        known = np.isfinite(values[low:high])
        if np.count_nonzero(known) >= least:
            result[segment] = _affine_ends(fraction[low:high][known], 1.0 / values[low:high][known], tolerance, least)
    return result


def _foremost_depth(depth: np.ndarray, pixels: np.ndarray, jump: float = 0.15) -> np.ndarray:
    """Return the median of those of the 3 x 3 depths that are within `jump` (relative) of the nearest, NaN = none.

    The nearest itself would be biased: on a floor seen at a grazing angle, and under noise, one of nine pixels is
    always nearer by a few per cent, and edges that are too near make the whole map too small.
    """
    height, width = depth.shape
    columns, rows = np.rint(pixels).astype(np.int64).T
    around = np.stack(
        [
            depth[np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)]
            for dy in (-1, 0, 1)
            for dx in (-1, 0, 1)
        ]
    ).astype(np.float64)
    ordered = np.sort(around, axis=0)  # NaN last
    with np.errstate(invalid="ignore"):
        count = (ordered <= ordered[0] * (1.0 + jump)).sum(axis=0)
    middle = np.maximum(count - 1, 0)
    pick = lambda row: np.take_along_axis(ordered, row[None], axis=0)[0]
    return 0.5 * (pick(middle // 2) + pick((middle + 1) // 2))


def _affine_ends(fraction: np.ndarray, inverse: np.ndarray, tolerance: float, least: int) -> np.ndarray:
    first, second = _far_apart(len(fraction))
    slope = (inverse[second] - inverse[first]) / (fraction[second] - fraction[first])
    offset = inverse[first] - slope * fraction[first]
    explained = np.abs(offset[:, None] + slope[:, None] * fraction - inverse) < tolerance * inverse
    score = explained.sum(axis=1) + 1e-3 * offset / max(offset.max(), 1e-9)
    best = explained[int(np.argmax(score))]
    if np.count_nonzero(best) < max(least, len(fraction) // 2):
        return np.full(2, np.nan)
    x, y = fraction[best], inverse[best]
    centred = x - x.mean()
    slope_fit = (centred @ y) / (centred @ centred)
    offset_fit = y.mean() - slope_fit * x.mean()
    ends = np.array([offset_fit, offset_fit + slope_fit])
    return 1.0 / ends if (ends > 1e-3).all() else np.full(2, np.nan)


@cache
def _far_apart(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of samples that are at least a third of the segment apart."""
    return np.triu_indices(count, k=max(1, count // 3))
