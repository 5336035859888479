"""Matching line segments by dense descriptors sampled along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from vggtgeo.models.checks import check_fields
from vggtgeo.models.classical.line_gates import allowed_pairs
from vggtgeo.models.classical.nearest import mutual_nearest
from vggtgeo.models.onnx.dinov3 import DinoFeatures
from vggtgeo.models.roles import LineFeatures, LineMatches, RelativeView, Segments


@dataclass(frozen=True, eq=False)
class DenseLineMatcher:
    """A `LineMatcher`. Two segments are as alike as their samples: each sample takes the best of the other segment's,
    and the means of both directions are averaged, so that a segment that is seen in part still matches.

    samples: along each segment. ratio: largest ratio of the best to the second-best distance. similarity: least mean
    inner product of a pair. angle, distance, overlap: of the geometric gate, see `BandLineMatcher`.
    """

    features: DinoFeatures
    samples: int = 8
    ratio: float = 0.95
    similarity: float = 0.5
    angle: float = float(np.deg2rad(30.0))
    distance: float = 12.0
    overlap: float = 0.3

    def __post_init__(self) -> None:
        check_fields(self, samples="[2, inf)", ratio="(0, 1]")

    def describe(self, image: np.ndarray, segments: Segments) -> LineFeatures:
        """Return descriptors float16 [L, samples, C] along `segments` of `image` (uint8 [H, W, 3])."""
        if not len(segments):
            return LineFeatures(segments, np.zeros((0, self.samples, 1), np.float16))
        place = ((np.arange(self.samples) + 0.5) / self.samples)[:, None]
        ends = segments.endpoints
        pixels = ends[:, None, 0] + place * (ends[:, None, 1] - ends[:, None, 0])
        vectors = self.features.describe(image).at(pixels.reshape(-1, 2))
        return LineFeatures(segments, vectors.reshape(len(segments), self.samples, -1).astype(np.float16))

    def match(
        self, features_i: LineFeatures, features_j: LineFeatures, relative: RelativeView | None = None
    ) -> LineMatches:
        """Return the matches from view i to view j; see `LineMatcher.match`."""
        ends_i, ends_j = features_i.segments.endpoints, features_j.segments.endpoints
        allowed = allowed_pairs(ends_i, ends_j, relative, self.angle, self.distance, self.overlap)
        similarity = np.where(allowed, segment_similarity(features_i.descriptors, features_j.descriptors), -np.inf)
        index_i, index_j, clarity = mutual_nearest(similarity, self.ratio, self.similarity)
        return LineMatches(index_i, index_j, np.clip(1.0 - clarity**2, 0.05, 1.0))


def segment_similarity(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return float32 [I, J] in [-1, 1] of unit descriptors [I, n, C] and [J, m, C] along two sets of segments."""
    if not len(first) or not len(second):
        return np.zeros((len(first), len(second)), np.float32)
    flat = first.reshape(-1, first.shape[2]).astype(np.float32)
    other = second.reshape(-1, second.shape[2]).astype(np.float32)
    products = (flat @ other.T).reshape(len(first), first.shape[1], len(second), second.shape[1])
    return 0.5 * (products.max(axis=3).mean(axis=1) + products.max(axis=1).mean(axis=2))
