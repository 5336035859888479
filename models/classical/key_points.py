"""Selection of key points that cover the image."""

from __future__ import annotations

import numpy as np


def spread(pixels: np.ndarray, scores: np.ndarray, count: int, size: tuple[int, int], cells: int = 10) -> np.ndarray:
    """Return indices (int [<= count], best first) of key points that are strong and cover the image.

    The image has a grid of square cells, `cells` columns. Points are taken in rounds: the strongest of every cell, then
    the second strongest of every cell, and so on. So a poor region keeps its points, and a rich one loses its weakest.
    Cost: one sort.

    pixels: float [M, 2]. scores: float [M]. size: (width, height) of the image.
    """
    if not len(pixels):
        return np.zeros(0, dtype=np.int64)
    cell = max(size[0] / cells, 1.0)
    columns, rows = (pixels // cell).astype(np.int64).T
    bucket = rows * (cells + 1) + columns
    order = np.lexsort((-scores, bucket))
    starts = np.flatnonzero(np.diff(bucket[order], prepend=bucket[order[0]] - 1))
    lengths = np.diff(starts, append=len(order))
    rank = np.arange(len(order)) - np.repeat(starts, lengths)
    return order[np.lexsort((-scores[order], rank))][:count]
