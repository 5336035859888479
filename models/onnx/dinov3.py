"""DINOv3 (Siméoni et al., 2025): dense confidence from its attention, and line matches by descriptors of patches."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from vggtgeo.models.classical.lines import match_segments
from vggtgeo.models.classical.pixel_matcher import unit
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.contracts import DINOV3
from vggtgeo.models.onnx.fit import Fit, vectors_at
from vggtgeo.models.onnx.session import NetworkValueError, Session
from vggtgeo.models.roles import LineFeatures, LineMatches, RelativeView, Segments

from vggtgeo.io.argument_checks import check_fields

PREFIX = 5
"""Tokens before the patches: the class token and four registers."""


@dataclass(frozen=True, eq=False)
class DinoFeatures:
    """The network on one image: saliency Omega (a `DenseConfidence`) and descriptors.

    Omega = s / (1 + s), with s the attention of the class token to a patch, mean over the heads of the last block, in
    units of the mean over patches: 1/2 where a patch gets as much as on average.
    """

    session: Session
    cache: OutputCache = field(default_factory=MemoryCache)

    def confidence(self, image: np.ndarray) -> np.ndarray:
        outputs, fit = self._outputs(image)
        omega = saliency(outputs["attention"]).reshape(_grid(fit))
        fine = cv2.resize(omega, fit.network_size[::-1], interpolation=cv2.INTER_LINEAR)
        return fit.map_to_image(fine)

    def descriptors(self, image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return unit descriptors float32 [n, C] at `pixels` [n, 2] of `image`: those of the patches, less their mean,
        which all patches of an image share.
        """
        outputs, fit = self._outputs(image)
        patches = outputs["patch_descriptors"].astype(np.float32)
        grid = unit(patches - patches.mean(axis=0)).reshape(*_grid(fit), -1)
        return vectors_at(grid, fit.to_network(pixels), fit.network_size)

    def _outputs(self, image: np.ndarray) -> tuple[Outputs, Fit]:
        fit = self.session.fit(image)
        return self.cache.get((self.session,), ("features",), (image,), lambda: self._run(image, fit)), fit

    def _run(self, image: np.ndarray, fit: Fit) -> Outputs:
        found = self.session.run({"image": self.session.prepare(image, fit)})
        patches = found["attention"][0, :, 0, PREFIX:]
        if patches.min() < 0 or not patches.any():  # its rows sum to 1
            raise NetworkValueError(
                f"`{self.session.path}` gave an `attention` of {patches.min():.3g} to {patches.max():.3g}; it must be "
                "at least 0 and not all 0"
            )
        # Half precision suffices for descriptors that are compared by angle, and halves the cache.
        return {
            "attention": found["attention"][0, :, 0, :],
            "patch_descriptors": found["patch_descriptors"][0].astype(np.float16),
        }


def _grid(fit: Fit) -> tuple[int, int]:
    return fit.network_size[0] // DINOV3.multiple, fit.network_size[1] // DINOV3.multiple


def saliency(attention: np.ndarray) -> np.ndarray:
    """Return omega of each patch, float32 [P], of the class token's attention float [heads, 5 + P]."""
    patches = attention[:, PREFIX:].astype(np.float32).mean(axis=0)
    relative = patches / np.maximum(patches.mean(), np.float32(1e-12))
    return relative / (1.0 + relative)


@dataclass(frozen=True, eq=False)
class DenseLineMatcher:
    """A `LineMatcher`. Two segments are as alike as their samples: each sample takes the best of the other segment's,
    and the means of both directions are averaged, so that a segment that is seen in part still matches.

    samples: along each segment. ratio: largest ratio of the best to the second-best distance. similarity: least mean
    inner product of a pair.
    """

    features: DinoFeatures
    samples: int = 8
    ratio: float = 0.95
    similarity: float = 0.5

    def __post_init__(self) -> None:
        check_fields(self, samples="[2, inf)", ratio="(0, 1]")

    def describe(self, image: np.ndarray, segments: Segments) -> LineFeatures:
        """Return descriptors float16 [L, samples, C] along `segments` of `image` (uint8 [H, W, 3])."""
        if not len(segments):
            return LineFeatures(segments, np.zeros((0, self.samples, 1), np.float16))
        place = ((np.arange(self.samples) + 0.5) / self.samples)[:, None]
        ends = segments.endpoints
        pixels = ends[:, None, 0] + place * (ends[:, None, 1] - ends[:, None, 0])
        vectors = self.features.descriptors(image, pixels.reshape(-1, 2))
        return LineFeatures(segments, vectors.reshape(len(segments), self.samples, -1).astype(np.float16))

    def match(
        self, features_i: LineFeatures, features_j: LineFeatures, relative: RelativeView | None = None
    ) -> LineMatches:
        similarity = segment_similarity(features_i.descriptors, features_j.descriptors)
        return match_segments(similarity, features_i, features_j, relative, self.ratio, self.similarity)


def segment_similarity(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return float32 [I, J] in [-1, 1] of unit descriptors [I, n, C] and [J, m, C] along two sets of segments."""
    if not len(first) or not len(second):
        return np.zeros((len(first), len(second)), np.float32)
    flat = first.reshape(-1, first.shape[2]).astype(np.float32)
    other = second.reshape(-1, second.shape[2]).astype(np.float32)
    products = (flat @ other.T).reshape(len(first), first.shape[1], len(second), second.shape[1])
    return 0.5 * (products.max(axis=3).mean(axis=1) + products.max(axis=1).mean(axis=2))
