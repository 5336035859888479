"""Unit descriptors and their mutual nearest neighbours, by one matrix product."""

from __future__ import annotations

import numpy as np


def unit(vectors: np.ndarray, least: float = 1e-9) -> np.ndarray:
    """Return `vectors` [..., C] normalised to length 1; those shorter than `least` stay shorter."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), least)


def mutual_nearest(
    similarity: np.ndarray, ratio: float, floor: float = -1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs that are each other's best and pass the ratio test.

    similarity: float [I, J], inner products of unit vectors; -inf where a pair is excluded. It is overwritten.
    ratio: accept when distance(best) < ratio * distance(second) (Lowe 2004).
    floor: minimum similarity of a pair.

    Returns index_i int [m], index_j int [m], and the distance ratio float [m] of each pair.
    """
    rows, columns = similarity.shape
    if rows == 0 or columns == 0:
        empty = np.zeros(0, dtype=np.int64)
        return empty, empty, np.zeros(0)
    best_j = similarity.argmax(axis=1)
    best = similarity[np.arange(rows), best_j]
    # A maximum along columns is read row by row; an argmax is not, and takes five times as long.
    index_i = np.nonzero((best >= similarity.max(axis=0)[best_j]) & (best > floor))[0]
    # A column is matched once: to the first of equal descriptors.
    index_i = np.sort(index_i[np.unique(best_j[index_i], return_index=True)[1]])
    index_j, best = best_j[index_i], best[index_i]
    similarity[index_i, index_j] = -np.inf
    second = similarity[index_i].max(axis=1, initial=-1.0)
    clarity = distance_ratio(best, second)
    keep = clarity < ratio
    return index_i[keep], index_j[keep], clarity[keep]


def distance_ratio(best: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the ratio of the best to the second-best distance of unit vectors; distance^2 = 2 - 2 similarity."""
    return np.sqrt(np.maximum(1.0 - best, 0.0) / np.maximum(1.0 - second, 1e-6))


def exclude_far(similarity: np.ndarray, predicted: np.ndarray, pixels: np.ndarray, radius: float) -> None:
    """Set `similarity` [I, J] to -inf, in place, where `pixels` [J, 2] is beyond `radius` of `predicted` [I, 2].

    Rows with a NaN prediction are unchanged.
    """
    dx = predicted[:, 0, None] - pixels[:, 0]
    dy = predicted[:, 1, None] - pixels[:, 1]
    similarity[dx * dx + dy * dy > radius * radius] = -np.inf
