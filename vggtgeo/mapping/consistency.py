"""Several views of one surface: what no other view confirms is dropped, what several do is averaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.models import pinhole

SIGMAS = 2.5
"""Standard deviations by which views of one surface may differ: 99 % of a normal distribution."""
AGREE = 0.01, 0.03
"""Relative difference of views that is always, and that is never, allowed for."""


@dataclass(frozen=True, eq=False)
class PosedDepth:
    """A depth map with its camera. pose: float64 [4, 4], world -> camera; intrinsics: float64 [4]."""

    depth_map: DepthMap
    pose: np.ndarray
    intrinsics: np.ndarray


def confirm(own: PosedDepth, others: Sequence[PosedDepth], least: int) -> DepthMap:
    """The depth map without what fewer than `least` others confirm, the rest averaged by information.

    A view confirms a pixel if its own depth, where it sees the pixel's point, is the same within the noise of both. The
    errors of views of one surface have images in common, so that the mean is taken for as sure as the best of them, not
    surer. Confidence is 1 - 2^-n of n confirming views.
    """
    depth_map = own.depth_map.opened()
    depth, variance = depth_map.depth, (depth_map.sigma * depth_map.depth) ** 2
    rays = pinhole.grid_rays((depth.shape[0], depth.shape[1]), own.intrinsics, np.float32)
    weight = 1.0 / variance
    total, moment, count, best = weight.copy(), weight * depth, np.zeros(depth.shape, np.int32), variance.copy()
    for other in others:
        z, z_variance = _seen_by(own, other, depth, rays)
        with np.errstate(invalid="ignore"):
            gate = np.clip(SIGMAS * np.sqrt(variance + z_variance), AGREE[0] * depth, AGREE[1] * depth)
            same = np.abs(z - depth) < gate
        count += same
        gain = np.where(same, 1.0 / z_variance, 0.0)
        total += gain
        moment += np.where(same, gain * z, 0.0)
        best = np.where(same, np.minimum(best, z_variance), best)
    good = (count >= least) & np.isfinite(depth)
    mean = moment / total
    nan = np.float32(np.nan)
    return DepthMap(
        np.where(good, mean, nan).astype(np.float32),
        np.where(good, np.sqrt(best) / mean, nan).astype(np.float32),
        np.where(good, 1.0 - 0.5**count, 0.0).astype(np.float32),
    )


def _seen_by(own: PosedDepth, other: PosedDepth, depth: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth along `own`'s rays by what `other` sees at each pixel's point, and its variance; NaN where it sees nothing.

    The difference of depth in the other's frame is carried over as a relative one: the point moves along a ray that is
    nearly the same.
    """
    relative = (other.pose @ np.linalg.inv(own.pose)).astype(np.float32)
    local = (rays * depth[..., None]) @ relative[:3, :3].T + relative[:3, 3]
    flat = local.reshape(-1, 3)
    inside, rows, columns = pinhole.visible(flat, other.intrinsics, other.depth_map.shape)
    z, variance = np.full(len(flat), np.nan, np.float32), np.full(len(flat), np.nan, np.float32)
    seen, sigma = other.depth_map.depth[rows, columns], other.depth_map.sigma[rows, columns]
    z[inside] = depth.reshape(-1)[inside] * seen / flat[inside, 2]
    variance[inside] = (sigma * z[inside]) ** 2
    return z.reshape(depth.shape), variance.reshape(depth.shape)
