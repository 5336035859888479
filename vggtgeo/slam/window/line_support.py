"""Selection of the samples of a segment, and of those that its match in another view constrains."""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import rigid


def supported(
    points: np.ndarray, pose: np.ndarray, endpoints: np.ndarray, intrinsics: np.ndarray, *, reach: float, gate: float
) -> np.ndarray:
    """Return whether each world point projects next to its matched segment, bool [m].

    A segment constrains points along its own length: beyond its ends the error of its direction grows with the
    distance, and points behind the camera have no valid projection.

    points: float64 [m, 3], metres, by the current estimate. pose: world -> camera of the view. endpoints: float64
    [m, 2, 2], the segment of each point, pixels. reach: largest distance beyond an end, pixels; gate: largest
    distance from the line, pixels.
    """
    pixels = rigid.project(points, pose, intrinsics)
    along = endpoints[:, 1] - endpoints[:, 0]
    length = np.linalg.norm(along, axis=1)
    # Degenerate segments have a length of zero.
    direction = along / np.maximum(length, 1e-9)[:, None]
    offset = pixels - endpoints[:, 0]
    place = (offset * direction).sum(1)
    distance = np.abs(offset[:, 0] * direction[:, 1] - offset[:, 1] * direction[:, 0])
    # A comparison with NaN (behind the camera) is false.
    return (place > -reach) & (place < length + reach) & (distance < gate)


def spread_samples(segment: np.ndarray, most: int) -> np.ndarray:
    """Select at most `most` samples of each segment, evenly spread from its first to its last, bool [m].

    segment: int [m], segment of each sample; those of one segment stand together.
    """
    rank, count = _ranks(segment)
    take = np.minimum(count, most)
    # The k-th one has rank round(k (count - 1) / (take - 1)): a rank is taken if that of the nearest k is itself.
    nearest = np.rint(rank * np.maximum(take - 1, 0) / np.maximum(count - 1, 1))
    return np.rint(nearest * (count - 1) / np.maximum(take - 1, 1)) == rank


def sample_shares(segment: np.ndarray, most: int) -> np.ndarray:
    """Return how many samples of its segment each of `spread_samples` represents, float64 [m]."""
    _, count = _ranks(segment)
    return count / np.maximum(np.minimum(count, most), 1)


def _ranks(segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of each sample on its segment, and the number of samples of that segment."""
    count = np.bincount(segment, minlength=1)
    first = np.cumsum(count) - count
    return np.arange(len(segment)) - first[segment], count[segment]
