"""Point matches by unit descriptors of key points, and the global descriptor of an image.

SIFT (Lowe 2004; RootSIFT distances, Arandjelovic and Zisserman 2012), ORB (Rublee et al. 2011), an order of magnitude
faster and less exact, and networks (ALIKE, XFeat). Matches are mutual nearest neighbours by one matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import cv2
import numpy as np
from scipy.spatial import cKDTree
from vggtgeo.models.classical.sub_pixel import PatchAlignment
from vggtgeo.models.classical.verification import EpipolarVerifier
from vggtgeo.models.roles import Features, PointMatches

from vggtgeo.io.argument_checks import check_fields


@dataclass(frozen=True)
class PixelDescriptors:
    """vectors: float32 [M, D] of unit length. gray: uint8 [H, W], their image."""

    vectors: np.ndarray
    gray: np.ndarray


@dataclass(frozen=True)
class PixelMatcher:
    """Base of the `PointMatcher`s whose descriptors are `PixelDescriptors`.

    count: maximum number of key points in an image. ratio: maximum ratio of the best to the second-best descriptor
    distance. radius: maximum distance of a match from its predicted position, pixels, if there is a prediction.
    refinement: sub-pixel alignment of the targets, or None.
    """

    count: int = 1500
    ratio: float = 0.92
    radius: float = 60.0
    verifier: EpipolarVerifier = field(default_factory=EpipolarVerifier)
    refinement: PatchAlignment | None = field(default_factory=PatchAlignment)

    def __post_init__(self) -> None:
        check_fields(self, count="[1, inf)", ratio="(0, 1]")

    def match(self, features_i: Features, features_j: Features, predicted: np.ndarray | None = None) -> PointMatches:
        first: PixelDescriptors = features_i.descriptors
        second: PixelDescriptors = features_j.descriptors
        similarity = first.vectors @ second.vectors.T
        if predicted is not None:
            exclude_far(similarity, predicted, features_j.pixels, self.radius)
        index_i, index_j, clarity = mutual_nearest(similarity, self.ratio)
        pixels_i, pixels_j = features_i.pixels[index_i], features_j.pixels[index_j]
        matches = PointMatches(index_i, index_j, pixels_i, pixels_j, confidence_of(clarity))
        return verified(matches, self.verifier, self.refinement, first.gray, second.gray)


def verified(
    matches: PointMatches,
    verifier: EpipolarVerifier,
    refinement: PatchAlignment | None,
    gray_i: np.ndarray,
    gray_j: np.ndarray,
) -> PointMatches:
    """Return the matches that the verifier accepts, with targets refined to sub-pixels in two images, uint8 [H, W]."""
    matches = matches.select(verifier.inliers(matches.pixels_i, matches.pixels_j))
    if refinement is None or not len(matches):
        return matches
    targets, _ = refinement.refine(gray_i, gray_j, matches.pixels_i, matches.pixels_j)
    return replace(matches, pixels_j=targets)


def confidence_of(clarity: np.ndarray) -> np.ndarray:
    """Return confidence in [0.02, 1] of matches with distance ratio `clarity`, float [m].

    The exponent makes it proportional to the inverse square of the residual: on two indoor clips the median
    reprojection error fell from 1.2 to 0.5 px and from 0.9 to 0.4 px between the least and the most clear eighth, and
    the share of wrong matches from 12 % to below 1 %.
    """
    return np.clip(1.0 - clarity**2, 0.02 ** (2 / 3), 1.0) ** 1.5


_CELLS = 10
"""Columns of the grid over which key points are spread."""


def spread(pixels: np.ndarray, scores: np.ndarray, count: int, size: tuple[int, int]) -> np.ndarray:
    """Return indices (int [<= count], best first) of key points that are strong and cover the image.

    The image has a grid of square cells in `_CELLS` columns. Points are taken in rounds: the strongest of every cell,
    then the second strongest of every cell, and so on. So a poor region keeps its points, and a rich one loses its
    weakest. Cost: one sort.

    pixels: float [M, 2]. scores: float [M]. size: (width, height) of the image.
    """
    if not len(pixels):
        return np.zeros(0, dtype=np.int64)
    cell = max(size[0] / _CELLS, 1.0)
    columns, rows = (pixels // cell).astype(np.int64).T
    bucket = rows * (_CELLS + 1) + columns
    order = np.lexsort((-scores, bucket))
    starts = np.flatnonzero(np.diff(bucket[order], prepend=bucket[order[0]] - 1))
    lengths = np.diff(starts, append=len(order))
    rank = np.arange(len(order)) - np.repeat(starts, lengths)
    return order[np.lexsort((-scores[order], rank))][:count]


@dataclass(frozen=True)
class OrbMatcher(PixelMatcher):
    """ORB key points spread over the image, mutual Hamming matches, verified epipolar geometry.

    ratio: maximum ratio of the square roots of the best and the second-best Hamming distance. Other fields:
    `PixelMatcher`.
    """

    @cached_property
    def _orb(self) -> cv2.ORB:
        # Twice the points, so that `spread` has a choice.
        return cv2.ORB_create(nfeatures=2 * self.count, fastThreshold=10)

    def describe(self, image: np.ndarray) -> Features:
        """Return key points and binary vectors of `image` (uint8 [H, W, 3]); none on a blank image."""
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        points, bits = self._orb.detectAndCompute(gray, None)
        pixels = np.array([p.pt for p in points], dtype=np.float64).reshape(-1, 2)
        scores = np.array([p.response for p in points], dtype=np.float64)
        keep = spread(pixels, scores, self.count, gray.shape[::-1])
        bits = np.zeros((0, 32), np.uint8) if bits is None else bits[keep]
        return Features(pixels[keep], scores[keep], PixelDescriptors(_signs(bits), gray))


def _signs(bits: np.ndarray) -> np.ndarray:
    """Return 256 bits as a unit vector of signs, so that an inner product s is a Hamming distance: 128 (1 - s)."""
    return (np.unpackbits(bits, axis=1).astype(np.float32) * 2.0 - 1.0) / 16.0


@dataclass(frozen=True)
class SiftMatcher(PixelMatcher):
    """SIFT key points spread over the image, mutual RootSIFT matches, verified epipolar geometry.

    contrast: detection threshold; a smaller one finds more and fainter points. area: maximum number of pixels for
    detection; larger images are reduced, and the refinement at full resolution makes up for it (640 x 480: half the
    time for the same trajectory error). Other fields: `PixelMatcher`.
    """

    ratio: float = 0.85
    contrast: float = 0.005
    area: int = 172_800

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, area="[10000, inf)")

    @cached_property
    def _sift(self) -> cv2.SIFT:
        # The precise upscale removes the quarter-pixel shift that the doubled first octave brings in.
        return cv2.SIFT_create(contrastThreshold=self.contrast, enable_precise_upscale=True)

    def describe(self, image: np.ndarray) -> Features:
        """Return key points and RootSIFT vectors of `image` (uint8 [H, W, 3]); none on a blank image."""
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        small, ratio = _shrunk(gray, self.area)
        points, vectors = self._sift.detectAndCompute(small, None)
        # Pixel centres, not corners, are integers: hence the halves.
        pixels = (np.array([p.pt for p in points], dtype=np.float64).reshape(-1, 2) + 0.5) * ratio - 0.5
        scores = np.array([p.response for p in points], dtype=np.float64)
        keep = spread(pixels, scores, self.count, gray.shape[::-1])
        vectors = np.zeros((0, 128), np.float32) if vectors is None else vectors[keep]
        return Features(pixels[keep], scores[keep], PixelDescriptors(_root(vectors), gray))


def _root(vectors: np.ndarray) -> np.ndarray:
    """Return RootSIFT: square roots of L1-normalised histograms have unit length and compare by Hellinger's kernel."""
    total = np.maximum(vectors.sum(axis=1, keepdims=True), 1e-7)
    return np.sqrt(vectors / total)


def _shrunk(gray: np.ndarray, area: int) -> tuple[np.ndarray, np.ndarray]:
    """Shrink `gray` to about `area` pixels; return it and how many of its pixels a new one spans, float [2] (x, y)."""
    scale = np.sqrt(area / gray.size)
    if scale >= 1.0:
        return gray, np.ones(2)
    size = tuple(max(round(side * scale), 1) for side in gray.shape[::-1])
    return cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.array(gray.shape[::-1]) / size


_NEIGHBOURS = 4
"""Key points near a predicted position that are compared; there are never more within some pixels."""
_RATIO, _SIMILARITY = 0.85, 0.8
"""Of a search near a predicted position: largest ratio of distances, least inner product."""


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
) -> PointMatches:
    """Return the matches of some key points of view i within `radius` pixels of their predicted position in view j.

    The most similar key point there is matched if its inner product is at least `_SIMILARITY` and the ratio of
    distances to the second best is below `_RATIO` (Lowe). A key point of j is matched once, to the most similar. There
    is no epipolar verification: the predicted position is stricter.

    index: int [n], key points of i. predicted: float [n, 2], pixels. tree: `search_tree(features_j)`.
    """
    if not len(index) or not len(features_j):
        return PointMatches.none()
    first, second = _vectors(features_i), _vectors(features_j)
    _, near = tree.query(predicted, k=_NEIGHBOURS, distance_upper_bound=radius)
    there = near < len(features_j)
    alike = np.einsum("nd,nkd->nk", first[index], second[np.where(there, near, 0)])
    alike = np.where(there, alike, -1.0)
    order = np.argsort(-alike, axis=1)
    rows = np.arange(len(index))
    best, next_best = alike[rows, order[:, 0]], alike[rows, order[:, 1]]
    clarity = distance_ratio(best, next_best)
    good = np.nonzero((best > _SIMILARITY) & (clarity < _RATIO))[0]
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
) -> PointMatches:
    """Return mutual matches within a larger `radius`, for rough predictions; otherwise as `search_near`."""
    similarity = _vectors(features_i)[index] @ _vectors(features_j).T
    exclude_far(similarity, predicted, features_j.pixels, radius)
    rows, target, clarity = mutual_nearest(similarity, _RATIO)
    own = index[rows]
    return PointMatches(own, target, features_i.pixels[own], features_j.pixels[target], confidence_of(clarity))


def _vectors(features: Features) -> np.ndarray:
    descriptors: PixelDescriptors = features.descriptors
    return descriptors.vectors


_BITS = 5


def global_descriptor(features: Features) -> np.ndarray | None:
    """Return the global descriptor of an image, a unit vector, float32 `[2^bits * D]`: aggregated local descriptors
    (VLAD, Jegou et al. 2010). None for descriptors without vectors, or fewer than 20 points.

    Each descriptor, minus the mean of its image, is assigned to one of 2^bits cells by the signs of its products with
    fixed random directions (Charikar 2002). This replaces a trained vocabulary and works for any descriptor. The sums
    of the cells, square-rooted and normalised per cell and then together, are the vector.
    """
    if not isinstance(features.descriptors, PixelDescriptors) or len(features) < 20:
        return None
    vectors = features.descriptors.vectors - features.descriptors.vectors.mean(0)
    cell = ((vectors @ _directions(vectors.shape[1])) > 0) @ (1 << np.arange(_BITS))
    sums = np.zeros((1 << _BITS, vectors.shape[1]), np.float32)
    np.add.at(sums, cell, vectors)
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    whole = sums.ravel()
    return whole / max(float(np.linalg.norm(whole)), 1e-9)


@cache
def _directions(length: int) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((length, _BITS)).astype(np.float32)


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
