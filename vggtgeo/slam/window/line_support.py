"""Which samples of a segment take part, and which of them its match in another view says something about."""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import rigid


def supported(
    points: np.ndarray, pose: np.ndarray, endpoints: np.ndarray, intrinsics: np.ndarray, *, reach: float, gate: float
) -> np.ndarray:
    """Whether each world point falls beside the segment it is matched to, bool [m].

    A segment speaks for its own length: beyond its ends the error of its direction grows with the distance, and what
    lies behind the camera (the near end of a long edge, in a turn) projects anywhere at all.

    points: float64 [m, 3], metres, by the current estimate. pose: world -> camera of the view. endpoints: float64
    [m, 2, 2], the segment of each point, pixels. reach: how far beyond an end still counts, gate: farthest from the
    line, pixels.
    """
    pixels = rigid.project(points, pose, intrinsics)
    along = endpoints[:, 1] - endpoints[:, 0]
    length = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(length, 1e-9)[:, None]
    offset = pixels - endpoints[:, 0]
    place = (offset * direction).sum(1)
    distance = np.abs(offset[:, 0] * direction[:, 1] - offset[:, 1] * direction[:, 0])
    # A comparison with NaN (behind the camera) is false.
    return (place > -reach) & (place < length + reach) & (distance < gate)


def spread_samples(segment: np.ndarray, most: int) -> np.ndarray:
    """Whether each sample is one of at most `most` of its segment, evenly spread from its first to its last, bool [m].

    segment: int [m], segment of each sample; those of one segment stand together.
    """
    rank, count = _ranks(segment)
    take = np.minimum(count, most)
    # The k-th one has rank round(k (count - 1) / (take - 1)): a rank is taken if that of the nearest k is itself.
    nearest = np.rint(rank * np.maximum(take - 1, 0) / np.maximum(count - 1, 1))
    return np.rint(nearest * (count - 1) / np.maximum(take - 1, 1)) == rank


def sample_shares(segment: np.ndarray, most: int) -> np.ndarray:
    """How many samples of its segment each of the `spread_samples` stands for, float64 [m]."""
    _, count = _ranks(segment)
    return count / np.maximum(np.minimum(count, most), 1)


def _ranks(segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position of each sample on its segment, and the number of samples there."""
    count = np.bincount(segment, minlength=1)
    first = np.cumsum(count) - count
    return np.arange(len(segment)) - first[segment], count[segment]
