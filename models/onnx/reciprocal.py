"""Fast reciprocal matching of dense descriptors (after Leroy et al., ECCV 2024), from a sparse set of starts.

Each start x of the first map goes to its nearest neighbour y of the second, and y back to its nearest neighbour x' of
the first; the match is kept where x' is within a tolerance of x. The cost is starts x pixels instead of pixels x
pixels. The search is made on every `stride`-th pixel, then among all pixels around the best of those.
"""

from __future__ import annotations

import numpy as np

_BLOCK = 256


def reciprocal(
    first: np.ndarray, second: np.ndarray, starts: np.ndarray, stride: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """Return targets int64 [m, 2] (x, y) in `second`, and the forward-backward errors, float64 [m], pixels.

    first, second: float32 [H, W, D], unit descriptors. starts: int [m, 2], pixels (x, y) of `first`.
    """
    targets = nearest(first[starts[:, 1], starts[:, 0]], second, stride)
    back = nearest(second[targets[:, 1], targets[:, 0]], first, stride)
    return targets, np.linalg.norm((back - starts).astype(np.float64), axis=1)


def nearest(queries: np.ndarray, grid: np.ndarray, stride: int = 1) -> np.ndarray:
    """Return the pixel (x, y) of `grid` [H, W, D] with the largest inner product with each query [m, D], int64 [m, 2].

    Exact for stride 1; otherwise exact where the coarse search ends within `stride` pixels of the best.
    """
    begin = stride // 2
    coarse = grid[begin::stride, begin::stride]
    flat = np.ascontiguousarray(coarse.reshape(-1, grid.shape[2]))
    best = np.concatenate(
        [np.zeros(0, np.int64)]
        + [(queries[row : row + _BLOCK] @ flat.T).argmax(axis=1) for row in range(0, len(queries), _BLOCK)]
    )
    y, x = np.divmod(best, coarse.shape[1])
    found = np.stack([x, y], axis=1) * stride + begin
    return found if stride == 1 else _around(queries, grid, found, stride)


def _around(queries: np.ndarray, grid: np.ndarray, found: np.ndarray, reach: int) -> np.ndarray:
    """Return the best pixel within `reach` of each found one."""
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    places = np.clip(found[:, None] + steps, 0, [grid.shape[1] - 1, grid.shape[0] - 1])
    products = np.einsum("md,mkd->mk", queries, grid[places[..., 1], places[..., 0]])
    return places[np.arange(len(places)), products.argmax(axis=1)]
