"""DINOv3 (Siméoni et al., 2025): dense confidence from its attention, and descriptors of its patches."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from vggtgeo.models.checks import check_image
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.contracts import DINOV3
from vggtgeo.models.onnx.fit import Fit, at_multiples
from vggtgeo.models.onnx.session import NetworkValueError, Session

PREFIX = 5
"""Tokens before the patches: the class token and four registers."""


@dataclass(frozen=True)
class DescriptorGrid:
    """Unit descriptors of patches, float32 [h, w, C], and the fit of the image."""

    grid: np.ndarray
    fit: Fit
    patch: int

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Return descriptors float32 [n, C], of unit length, at image pixels float [n, 2]: bilinear between patch
        centres.
        """
        place = (self.fit.to_network(np.asarray(pixels, np.float64)) + 0.5) / self.patch - 0.5
        height, width = self.grid.shape[:2]
        place = np.clip(place, 0.0, [width - 1, height - 1])
        low = np.minimum(place.astype(np.int64), np.maximum([width - 2, height - 2], 0))
        high = np.minimum(low + 1, [width - 1, height - 1])
        part = (place - low).astype(np.float32)
        (x0, y0), (x1, y1), (fx, fy) = low.T, high.T, part.T[..., None]
        top = (1 - fx) * self.grid[y0, x0] + fx * self.grid[y0, x1]
        bottom = (1 - fx) * self.grid[y1, x0] + fx * self.grid[y1, x1]
        return unit((1 - fy) * top + fy * bottom)


@dataclass(frozen=True, eq=False)
class DinoFeatures:
    """The network on one image: saliency Omega (a `DenseConfidence`) and the grid of descriptors.

    Omega = s / (1 + s), with s the attention of the class token to a patch, mean over the heads of the last block, in
    units of the mean over patches: 1/2 where a patch gets as much as on average.
    """

    session: Session
    cache: OutputCache = field(default_factory=MemoryCache)

    def confidence(self, image: np.ndarray) -> np.ndarray:
        """Return Omega, float32 [H, W] in [0, 1), of `image` (uint8 [H, W, 3])."""
        outputs, fit = self._outputs(image)
        rows, columns = (side // DINOV3.multiple for side in fit.network_size)
        omega = saliency(outputs["attention"]).reshape(rows, columns)
        fine = cv2.resize(omega, fit.network_size[::-1], interpolation=cv2.INTER_LINEAR)
        return fit.map_to_image(fine)

    def describe(self, image: np.ndarray) -> DescriptorGrid:
        """Return descriptors of the patches of `image`, less their mean, which all patches of an image share."""
        outputs, fit = self._outputs(image)
        rows, columns = (side // DINOV3.multiple for side in fit.network_size)
        grid = outputs["patch_descriptors"].astype(np.float32)
        return DescriptorGrid(unit(grid - grid.mean(axis=0)).reshape(rows, columns, -1), fit, DINOV3.multiple)

    def _outputs(self, image: np.ndarray) -> tuple[Outputs, Fit]:
        check_image("image", image)
        wanted = at_multiples(image.shape[:2], DINOV3.multiple)
        rows, columns = self.session.inputs["image"].shape[2:]
        fit = Fit.of(image.shape[:2], (rows or wanted[0], columns or wanted[1]))
        return self.cache.get((self.session,), ("features",), (image,), lambda: self._run(image, fit)), fit

    def _run(self, image: np.ndarray, fit: Fit) -> Outputs:
        found = self.session.run({"image": DINOV3.normalisation.apply(fit.resize(image))[None]})
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


def saliency(attention: np.ndarray) -> np.ndarray:
    """Return omega of each patch, float32 [P], of the class token's attention float [heads, 5 + P]."""
    patches = attention[:, PREFIX:].astype(np.float32).mean(axis=0)
    relative = patches / np.maximum(patches.mean(), np.float32(1e-12))
    return relative / (1.0 + relative)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return `vectors` [..., C] normalised to length 1; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.float32(1e-9))
