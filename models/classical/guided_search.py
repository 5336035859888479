"""Guided matching: key points near their predicted position in the other view, then by descriptor."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from vggtgeo.models.classical.nearest import exclude_far, mutual_nearest
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors, confidence_of
from vggtgeo.models.roles import Features, PointMatches

NEIGHBOURS = 4
"""Key points near a predicted position that are compared; there are never more within some pixels."""


def can_search(features: Features) -> bool:
    """Return whether the descriptors are vectors, which can be compared one by one."""
    return isinstance(features.descriptors, PixelDescriptors)


def search_tree(features: Features) -> cKDTree:
    """Return a search tree of the key points of a view."""
    return cKDTree(features.pixels.reshape(-1, 2))


def search_near(
    features_i: Features,
    index: np.ndarray,
    predicted: np.ndarray,
    features_j: Features,
    tree: cKDTree,
    *,
    radius: float,
    ratio: float = 0.85,
    similarity: float = 0.8,
) -> PointMatches:
    """Return the matches of some key points of view i within `radius` pixels of their predicted position in view j.

    The most similar key point there is matched if its inner product is at least `similarity` and the ratio of distances
    to the second best passes (Lowe's `ratio`). A key point of j is matched once, to the most similar. There is no
    epipolar verification: the predicted position is stricter.

    index: int [n], key points of i. predicted: float [n, 2], pixels. tree: `search_tree(features_j)`.
    """
    if not len(index) or not len(features_j):
        return PointMatches.none()
    first, second = _vectors(features_i), _vectors(features_j)
    _, near = tree.query(predicted, k=NEIGHBOURS, distance_upper_bound=radius)
    there = near < len(features_j)
    alike = np.einsum("nd,nkd->nk", first[index], second[np.where(there, near, 0)])
    alike = np.where(there, alike, -1.0)
    order = np.argsort(-alike, axis=1)
    rows = np.arange(len(index))
    best, next_best = alike[rows, order[:, 0]], alike[rows, order[:, 1]]
    clarity = np.sqrt(np.maximum(1.0 - best, 0.0) / np.maximum(1.0 - next_best, 1e-6))
    good = np.nonzero((best > similarity) & (clarity < ratio))[0]
    good = good[np.argsort(-best[good], kind="stable")]
    target = near[good, order[good, 0]]
    keep = np.sort(np.unique(target, return_index=True)[1])
    good, target = good[keep], target[keep]
    pixels_i, pixels_j = features_i.pixels[index[good]], features_j.pixels[target]
    return PointMatches(index[good], target, pixels_i, pixels_j, confidence_of(clarity[good]))


def search_around(
    features_i: Features,
    index: np.ndarray,
    predicted: np.ndarray,
    features_j: Features,
    *,
    radius: float,
    ratio: float = 0.85,
) -> PointMatches:
    """Return mutual matches within a larger `radius`, for rough predictions; otherwise as `search_near`."""
    similarity = _vectors(features_i)[index] @ _vectors(features_j).T
    exclude_far(similarity, predicted, features_j.pixels, radius)
    rows, target, clarity = mutual_nearest(similarity, ratio)
    own = index[rows]
    return PointMatches(own, target, features_i.pixels[own], features_j.pixels[target], confidence_of(clarity))


def _vectors(features: Features) -> np.ndarray:
    descriptors: Any = features.descriptors
    vectors: np.ndarray = descriptors.vectors
    return vectors
