"""A depth map with standard deviation and confidence of every pixel, and the consistency of several views: pixels that
too few of them confirm are dropped, others averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from vggtgeo.geometry import pinhole
from vggtgeo.slam.sparse_map.keyframe import CompressedImage, array_of

COMPRESS_FROM = 32
"""Number of keyframes from which depth maps are compressed in memory. At 640 x 480: 0.4 MB in place of 3.7 MB, 20 ms to
compress, 4 ms to decode one of the three images. So plain ones take at most 120 MB."""
SIGMAS = 2.5
"""Largest difference of two views of one surface, standard deviations: 99 % of a normal distribution."""
DIFFERENCE_RANGE = 0.01, 0.03
"""Bounds of that gate, as relative difference of depth."""


class DepthMap:
    """Depth, standard deviation and confidence of the pixels of an image.

    Args:
        depth: float32 [H, W], z in metres (arbitrary unit if the scale is free), NaN = unknown.
        sigma: float32 [H, W], relative standard deviation.
        confidence: float32 [H, W] in [0, 1], 0 where depth is unknown.

    """

    def __init__(self, depth: np.ndarray, sigma: np.ndarray, confidence: np.ndarray) -> None:
        self._parts: tuple[np.ndarray | CompressedImage, ...] = (depth, sigma, confidence)
        self._unit = 1.0
        self._known: float | None = None  # share of known pixels, if compressed

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self._parts[0].shape
        return height, width

    @property
    def depth(self) -> np.ndarray:
        """float32 [H, W], NaN = unknown."""
        found = array_of(self._parts[0])
        return found if self._known is None else found.astype(np.float32) * np.float32(self._unit)

    @property
    def sigma(self) -> np.ndarray:
        """float32 [H, W], relative."""
        found = array_of(self._parts[1])
        return found if self._known is None else found.astype(np.float32)

    @property
    def confidence(self) -> np.ndarray:
        """float32 [H, W] in [0, 1]."""
        found = array_of(self._parts[2])
        return found if self._known is None else found.astype(np.float32) / np.float32(255)

    @property
    def share(self) -> float:
        """Share of pixels with known depth."""
        return float(np.isfinite(self.depth).mean()) if self._known is None else self._known

    @property
    def is_compressed(self) -> bool:
        """Whether each access decodes an image."""
        return self._known is not None

    @property
    def empty(self) -> bool:
        """Whether all depth is unknown."""
        return self.share == 0

    def __repr__(self) -> str:
        return f"DepthMap({self.shape[1]} x {self.shape[0]}, {self.share:.0%} known)"

    def compressed(self) -> Self:
        """Return a compressed copy, with depth and sigma rounded to 0.05 %; each access decodes one image."""
        if self.is_compressed or self.empty:
            return self
        small = type(self)(self.depth, self.sigma, self.confidence)
        small._known = self.share
        small._unit = float(np.nanmedian(self.depth))  # keeps the range of half precision for any scale of the map
        scaled = (self.depth / small._unit).astype(np.float16), self.sigma.astype(np.float16)
        levels = np.rint(255 * self.confidence).astype(np.uint8)
        small._parts = tuple(CompressedImage.of(image) for image in (*scaled, levels))
        return small

    def compressed_for(self, keyframes: int) -> Self:
        """Return the depth map, compressed if the map has many keyframes."""
        return self.compressed() if keyframes >= COMPRESS_FROM else self

    def decoded(self) -> Self:
        """Return the depth map with plain arrays, for repeated access."""
        return self if self._known is None else type(self)(self.depth, self.sigma, self.confidence)


@dataclass(frozen=True, eq=False)
class PosedDepth:
    """A depth map with its camera. pose: float64 [4, 4], world -> camera; intrinsics: float64 [4]."""

    depth_map: DepthMap
    pose: np.ndarray
    intrinsics: np.ndarray


def confirm(own: PosedDepth, others: Sequence[PosedDepth], min_views: int) -> DepthMap:
    """Return the depth map where at least `min_views` others confirm it, averaged by information.

    A view confirms a pixel if its depth at the pixel's point agrees within the noise of both. The errors of the views
    are correlated, since they share images: the variance of the mean is that of the best view, not smaller. Confidence
    is 1 - 2^-n for n confirming views.
    """
    depth_map = own.depth_map.decoded()
    depth, variance = depth_map.depth, (depth_map.sigma * depth_map.depth) ** 2
    rays = pinhole.grid_rays((depth.shape[0], depth.shape[1]), own.intrinsics, np.float32)
    weight = 1.0 / variance
    total, moment, count, best = weight.copy(), weight * depth, np.zeros(depth.shape, np.int32), variance.copy()
    for other in others:
        z, z_variance = _depth_by(other, own, depth, rays)
        with np.errstate(invalid="ignore"):
            low, high = DIFFERENCE_RANGE
            same = np.abs(z - depth) < np.clip(SIGMAS * np.sqrt(variance + z_variance), low * depth, high * depth)
        count += same
        gain = np.where(same, 1.0 / z_variance, 0.0)
        total += gain
        moment += np.where(same, gain * z, 0.0)
        best = np.where(same, np.minimum(best, z_variance), best)
    good = (count >= min_views) & np.isfinite(depth)
    mean = moment / total
    nan = np.float32(np.nan)
    return DepthMap(
        np.where(good, mean, nan).astype(np.float32),
        # The best variance, not that of the mean: views share images and poses, so their errors do not average out.
        np.where(good, np.sqrt(best) / mean, nan).astype(np.float32),
        np.where(good, 1.0 - 0.5**count, 0.0).astype(np.float32),
    )


def _depth_by(other: PosedDepth, own: PosedDepth, depth: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth along `own`'s rays as measured by `other` at each pixel's point, and its variance; NaN where not
    visible.

    The relative depth error is taken over from the other view: its ray through the point is nearly the same.
    """
    # The product in double precision first: in single, positions far from the origin would lose the small difference.
    relative = (other.pose @ np.linalg.inv(own.pose)).astype(np.float32)
    local = (rays * depth[..., None]) @ relative[:3, :3].T + relative[:3, 3]
    flat = local.reshape(-1, 3)
    inside, rows, columns = pinhole.visible(flat, other.intrinsics, other.depth_map.shape)
    z, variance = np.full(len(flat), np.nan, np.float32), np.full(len(flat), np.nan, np.float32)
    seen, sigma = other.depth_map.depth[rows, columns], other.depth_map.sigma[rows, columns]
    # The ratio of depths is the same along nearly equal rays, whatever the distance between the two cameras.
    z[inside] = depth.reshape(-1)[inside] * seen / flat[inside, 2]
    variance[inside] = (sigma * z[inside]) ** 2
    return z.reshape(depth.shape), variance.reshape(depth.shape)
