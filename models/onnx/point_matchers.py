"""Point matchers: MASt3R (Leroy et al., ECCV 2024), an encoder once an image and a decoder once a pair; and ALIKE (Zhao
et al., IEEE Transactions on Multimedia 2022) and XFeat (Potje et al., CVPR 2024), which return maps of an image: a
score per pixel, and descriptors per pixel or per 8 x 8 block.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors, PixelMatcher, spread, verified
from vggtgeo.models.classical.sub_pixel import PatchAlignment
from vggtgeo.models.classical.verification import EpipolarVerifier
from vggtgeo.models.onnx.cache import MemoryCache, OutputCache, Outputs
from vggtgeo.models.onnx.contracts import NetworkFileError
from vggtgeo.models.onnx.fit import Fit, vectors_at
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.roles import Features, PointMatches

from vggtgeo.io.argument_checks import check_fields

_WANTED = ("descriptors_1", "descriptors_2", "descriptor_confidence_1", "descriptor_confidence_2")


@dataclass(frozen=True, eq=False)
class Mast3rView:
    """An image, its fit, and its key points in the network's pixels, int [M, 2]."""

    image: np.ndarray
    fit: Fit
    starts: np.ndarray


@dataclass(frozen=True, eq=False)
class Mast3rMatcher:
    """A `PointMatcher`. Key points: the strongest corner of each cell of the network's image; a match's target is any
    pixel, so `index_j` is -1.

    spacing: side of a cell, network pixels. tolerance: maximum forward-backward error, network pixels. stride: of the
    coarse search for nearest neighbours. corner: minimum corner strength (smaller eigenvalue of the structure tensor of
    an image in [0, 1]), so that blank walls have no key points. kept: number of images whose encoder features stay on
    the device.
    """

    encoder: Session
    decoder: Session
    cache: OutputCache = field(default_factory=MemoryCache)
    spacing: int = 8
    tolerance: float = 2.0
    stride: int = 2
    corner: float = 1e-5
    kept: int = 24
    verifier: EpipolarVerifier = field(default_factory=EpipolarVerifier)
    refinement: PatchAlignment | None = field(default_factory=PatchAlignment)
    _encoded: MemoryCache = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_fields(self, spacing="[1, inf)", stride="[1, inf)", tolerance="[0, inf)", kept="[2, inf)")
        object.__setattr__(self, "_encoded", MemoryCache(self.kept))
        self._check_pair()

    @property
    def size(self) -> tuple[int, int]:
        """Return (height, width) of the network's images, from the decoder's outputs."""
        height, width = self.decoder.outputs["descriptors_1"].shape[1:3]
        if height is None or width is None:
            raise NetworkFileError(
                f"`{self.decoder.path}` must have outputs of fixed size; export it with a height and a width"
            )
        return height, width

    def describe(self, image: np.ndarray) -> Features:
        """Return key points of `image` (uint8 [H, W, 3]); the network runs when they are matched."""
        fit = Fit.of(image.shape[:2], self.size)
        starts, strength = corners(fit.resize(image), self.spacing, self.corner)
        pixels = fit.to_image(starts.astype(np.float64))
        inside = fit.inside(pixels)
        return Features(pixels[inside], strength[inside], Mast3rView(image, fit, starts[inside]))

    def match(self, features_i: Features, features_j: Features, predicted: np.ndarray | None = None) -> PointMatches:
        """Return verified matches from view i to view j; see `PointMatcher.match`. `predicted` is not used."""
        first: Mast3rView = features_i.descriptors
        second: Mast3rView = features_j.descriptors
        settings = ("matches", self.spacing, self.corner, self.stride)
        images = (first.image, second.image)
        found = self.cache.get((self.encoder, self.decoder), settings, images, lambda: self._run(first, second))
        pixels_j = second.fit.to_image(found["targets"].astype(np.float64))
        index = np.flatnonzero(second.fit.inside(pixels_j) & (found["gap"] <= self.tolerance))
        matches = PointMatches(
            index,
            np.full(len(index), -1, np.int64),
            features_i.pixels[index],
            pixels_j[index],
            confidence_of(found["certainty"][index]),
        )
        gray_i, gray_j = (cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY) for view in (first, second))
        return verified(matches, self.verifier, self.refinement, gray_i, gray_j)

    def _run(self, first: Mast3rView, second: Mast3rView) -> Outputs:
        if not len(first.starts):
            return {"targets": np.zeros((0, 2), np.int32), "gap": np.zeros(0), "certainty": np.zeros(0)}
        features = {"features_1": self._encode(first), "features_2": self._encode(second)}
        found = self.decoder.run(features, _WANTED)
        targets, gap = reciprocal(found["descriptors_1"][0], found["descriptors_2"][0], first.starts, self.stride)
        (x, y), (u, v) = first.starts.T, targets.T
        certainty = np.minimum(found["descriptor_confidence_1"][0][y, x], found["descriptor_confidence_2"][0][v, u])
        return {"targets": targets.astype(np.int32), "gap": gap, "certainty": certainty}

    def _encode(self, view: Mast3rView) -> Any:
        """Return the encoder features of an image, which stay on the device for the next pairs."""
        run = lambda: self.encoder.run_on_device({"image": self.encoder.prepare(view.image, view.fit)})
        return self._encoded.get((), (), (view.image,), run)["features"]

    def _check_pair(self) -> None:
        given = (*self.encoder.inputs["image"].shape[2:], self.encoder.outputs["features"].shape[2])
        taken = (*self.size, self.decoder.inputs["features_1"].shape[2])
        if any(None not in sizes and sizes[0] != sizes[1] for sizes in zip(given, taken, strict=True)):
            raise NetworkFileError(
                f"`{self.encoder.path}` has height, width and channels {list(given)} and `{self.decoder.path}` "
                f"{list(taken)}, expected the same; export both from one checkpoint with one height and width"
            )


def corners(image: np.ndarray, spacing: int, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the strongest corner, int64 [M, 2] (x, y), of each cell of `spacing` pixels, and its strength, float64
    [M].

    image: uint8 [H, W, 3]. Cells whose strongest corner is below `least` have none.
    """
    strength = cv2.cornerMinEigenVal(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), blockSize=5, ksize=3)
    height, width = (side // spacing * spacing for side in strength.shape)
    cells = strength[:height, :width].reshape(height // spacing, spacing, width // spacing, spacing)
    flat = cells.transpose(0, 2, 1, 3).reshape(-1, spacing * spacing)
    best = flat.argmax(axis=1)
    cell_y, cell_x = np.divmod(np.arange(len(flat)), width // spacing)
    y, x = np.divmod(best, spacing)
    pixels = np.stack([cell_x * spacing + x, cell_y * spacing + y], axis=1)
    value = flat[np.arange(len(flat)), best].astype(np.float64)
    return pixels[value > least], value[value > least]


def confidence_of(certainty: np.ndarray) -> np.ndarray:
    """Return c / (1 + c) in [0, 1) of the network's certainty c > 0."""
    positive = np.maximum(np.asarray(certainty, np.float64), 0.0)
    return positive / (1.0 + positive)


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


_RADIUS = 2
"""Radius of non-maximum suppression, pixels, as published for both networks."""


@dataclass(frozen=True, eq=False)
class DensePointMatcher(PixelMatcher):
    """A `PointMatcher`. Key points: the local maxima of the score map, to a fraction of a pixel, spread over the image.

    score: minimum score, in [0, 1]; the authors use 0.2 (ALIKE) and 0.05 (XFeat), and less keeps faint points of white
    walls. Other fields: `PixelMatcher`.
    """

    session: Session = field(kw_only=True)
    cache: OutputCache = field(default_factory=MemoryCache)
    score: float = 0.02

    def describe(self, image: np.ndarray) -> Features:
        """Return key points and unit vectors of `image` (uint8 [H, W, 3]); none where no score is high enough."""
        settings = ("key points", self.count, self.score)
        found = self.cache.get((self.session,), settings, (image,), lambda: self._run(image))
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        return Features(found["pixels"], found["scores"], PixelDescriptors(found["vectors"], gray))

    def _run(self, image: np.ndarray) -> Outputs:
        fit = self.session.fit(image)
        scores, descriptors = (tensor.name for tensor in self.session.contract.outputs)
        maps = self.session.run({"image": self.session.prepare(image, fit)})
        places, strength = peaks(maps[scores][0, 0], self.score)
        pixels = fit.to_image(places)
        inside = np.flatnonzero(fit.inside(pixels))
        keep = inside[spread(pixels[inside], strength[inside], self.count, image.shape[1::-1])]
        vectors = vectors_at(maps[descriptors][0].transpose(1, 2, 0), places[keep], fit.network_size)
        return {"pixels": pixels[keep], "scores": strength[keep], "vectors": vectors}


def peaks(scores: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return local maxima of a map float [H, W] above `least`: float64 [M, 2] (x, y), and their values float64 [M].

    The place between pixels is the top of the parabolas through a maximum and its neighbours in each direction; where
    there is none, on a plateau or along a ridge, is no key point.
    """
    values = np.asarray(scores, np.float32)
    side = 2 * _RADIUS + 1
    highest = (values == cv2.dilate(values, np.ones((side, side), np.uint8))) & (values > least)
    inner = np.zeros_like(highest)
    inner[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS] = True
    y, x = np.nonzero(highest & inner)
    top = values[y, x].astype(np.float64)
    before = np.stack([values[y, x - 1], values[y - 1, x]], axis=1)
    after = np.stack([values[y, x + 1], values[y + 1, x]], axis=1)
    bend = 2.0 * top[:, None] - before - after
    good = (bend > 0).all(axis=1)
    step = 0.5 * (after - before)[good] / bend[good]  # within half a pixel, as the middle one is highest
    return np.stack([x, y], axis=1)[good] + step, top[good]
