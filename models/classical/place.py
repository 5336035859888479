"""Global descriptor of an image: aggregated local descriptors (VLAD, Jegou et al. 2010).

Each descriptor, minus the mean of its image, is assigned to one of 2^bits cells by the signs of its products with fixed
random directions (Charikar 2002). This replaces a trained vocabulary and works for any descriptor. The sums of the
cells, square-rooted and normalised per cell and then together, are the vector.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import Features

BITS = 5


def place_vector(features: Features) -> np.ndarray | None:
    """Return a unit vector, float32 `[2^bits * D]`; None for descriptors without vectors, or fewer than 20 points."""
    if not isinstance(features.descriptors, PixelDescriptors) or len(features) < 20:
        return None
    vectors = features.descriptors.vectors - features.descriptors.vectors.mean(0)
    cell = ((vectors @ _directions(vectors.shape[1])) > 0) @ (1 << np.arange(BITS))
    sums = np.zeros((1 << BITS, vectors.shape[1]), np.float32)
    np.add.at(sums, cell, vectors)
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    whole = sums.ravel()
    return whole / max(float(np.linalg.norm(whole)), 1e-9)


@cache
def _directions(length: int) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((length, BITS)).astype(np.float32)
