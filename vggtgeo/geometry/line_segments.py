"""Line segments before packing: positions of samples along their segment, and inverse depths affine along it.

Along the image of a 3D line, inverse depth is an affine function of the pixel. So the samples of a segment share two
unknowns instead of having one each (see `solvers/landmark_basis.py`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vggtgeo.io.errors import InputError


def numbered(group: np.ndarray) -> np.ndarray:
    """Return the number of each element among those of its group, in the given order."""
    order = np.argsort(group, kind="stable")
    number = np.empty(len(group), int)
    number[order] = np.arange(len(group)) - np.searchsorted(group[order], group[order])
    return number


def segment_slots(host: np.ndarray, segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the segments of each host, and the samples of each segment, in the given order.

    Args:
        host: int `[B]`, keyframe of each line sample.
        segment: int `[B]`, its segment; a number belongs to one host.

    Returns:
        int `[B]`, number of the sample's segment among those of its host, and of the sample on its segment.

    Raises:
        InputError: a sample without a segment, or a segment with samples in two keyframes.

    """
    if np.any(segment < 0):
        first = int(np.nonzero(segment < 0)[0][0])
        raise InputError(
            f"`segment` is {segment[first]} for a line sample; give every sample a segment, from 0, or none"
        )
    found: Any = np.unique(segment, return_index=True, return_inverse=True)
    _, first, inverse = found
    wrong = host != host[first][inverse]
    if np.any(wrong):
        raise InputError(
            f"`segment` {segment[wrong][0]} has samples hosted in two keyframes; number segments by keyframe"
        )
    order = np.argsort(first)
    rank = np.empty(len(first), int)
    rank[order] = numbered(host[first][order])
    return rank[inverse], numbered(inverse)


def fractions(pixels: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return the position of each sample along its segment, 0 at the first and 1 at the last one; 0 for absent samples.

    Args:
        pixels: `[n, g, q, 2]`.
        present: bool `[n, g, q]`; the samples of a segment come first.

    """
    count = present.sum(-1)
    last = np.maximum(count - 1, 0)
    start = pixels[:, :, :1]
    along = np.take_along_axis(pixels, last[:, :, None, None], 2) - start
    length = np.sum(along**2, -1)
    share = np.sum((pixels - start) * along, -1) / np.where(length > 0, length, 1.0)
    return np.where(present & (length > 0), share, 0.0)


def straightened(inverse_depth: np.ndarray, fraction: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return the affine functions of `fraction` nearest to the inverse depths, all `[n, g, q]`.

    The mean where the least-squares line is not positive everywhere.
    """
    weight = present.astype(inverse_depth.dtype)
    count = np.maximum(weight.sum(-1, keepdims=True), 1.0)
    mean = lambda values: (weight * values).sum(-1, keepdims=True) / count
    centre, level = mean(fraction), mean(np.where(present, inverse_depth, 0.0))
    spread = mean((fraction - centre) ** 2)
    slope = mean((fraction - centre) * np.where(present, inverse_depth, 0.0)) / np.where(spread > 0, spread, 1.0)
    line = level + slope * (fraction - centre)
    ends = np.minimum(level - slope * centre, level + slope * (1 - centre))
    # A line through noisy samples may cross infinity; the mean is positive.
    line = np.where(ends > 0, line, level)
    return np.where(count * level > 0, line, 1.0)
