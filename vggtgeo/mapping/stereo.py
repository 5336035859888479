"""Multi-view stereo: dense depth of each keyframe from pictures and adjusted poses alone.

Each keyframe is compared with the neighbours that see its points from a good angle (`stereo_views.py`), plane by plane
(`plane_sweep.py`); the costs are made a surface (`semi_global.py`), the surface gets a standard deviation
(`uncertainty.py`), and what the neighbours' own surfaces do not confirm is dropped (`consistency.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import jax.numpy as jnp
import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.mapping.consistency import PosedDepth, confirm
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.plane_sweep import Photo, matching_cost
from vggtgeo.mapping.semi_global import semi_global
from vggtgeo.mapping.stereo_views import choose_views, known_points
from vggtgeo.mapping.uncertainty import support
from vggtgeo.models import pinhole
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.threads import map_in_threads

LEAST_POINTS = 8
"""Known points in view, below which nobody knows between which depths to search."""
LARGEST_SIGMA = 0.05
"""Largest relative standard deviation of a depth: what is known worse would only blur the map."""
BLEND = 0.03
"""Relative difference of neighbouring depths above which nothing between them is made up in a larger image."""


@dataclass(frozen=True)
class StereoSettings:
    """views: neighbours that a keyframe is compared with, at most. planes: depths that are tried. size: longer side of
    the pictures in the search, pixels. window: width of the compared windows there, odd. smooth, jump: penalties of the
    regularisation, in units of 1 - correlation. margin: least lead of a pixel's plane, in the same unit. least_views:
    how many neighbours must agree on a depth.
    """

    views: int = 6
    planes: int = 96
    size: int = 320
    window: int = 7
    smooth: float = 0.04
    jump: float = 0.5
    margin: float = 0.02
    least_views: int = 2

    def __post_init__(self) -> None:
        least = {"views": 1, "planes": 8, "size": 32, "window": 3, "least_views": 1}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise InputError(f"`{name}` is {getattr(self, name)}; it must be at least {bound}")
        if self.window % 2 == 0 or not 0 < self.smooth <= self.jump:
            raise InputError("`window` must be odd, and 0 < `smooth` <= `jump`; correct the settings of the stereo")


def stereo_depths(
    keyframes: Sequence[Keyframe], intrinsics: np.ndarray, settings: StereoSettings | None = None
) -> list[DepthMap | None]:
    """Depth of each keyframe by its neighbours' pictures; None where no neighbour sees what it sees.

    Args:
        keyframes: adjusted; poses world -> camera.
        intrinsics: float64 [4], pixels.
        settings: of the search.

    """
    settings = settings or StereoSettings()
    views = choose_views(keyframes, intrinsics, settings.views)
    photos = [_photo(keyframe, intrinsics, settings.size) for keyframe in keyframes]
    points = [known_points(keyframe, intrinsics) for keyframe in keyframes]

    def search(i: int) -> PosedDepth | None:
        around = np.concatenate([points[j] for j in (i, *views[i])])
        depth_map = _search(around, photos[i], [photos[j] for j in views[i]], settings)
        return (
            None
            if depth_map is None
            else PosedDepth(depth_map.held_by(len(photos)), photos[i].pose, photos[i].intrinsics)
        )

    found = map_in_threads(search, range(len(photos)))  # a search holds some 150 MB
    result: list[DepthMap | None] = []
    for i, own in enumerate(found):
        others = [other for j in views[i] if (other := found[j]) is not None]
        confirmed = None if own is None else confirm(own, others, settings.least_views)
        if confirmed is None or confirmed.empty:
            result.append(None)
        else:
            result.append(enlarged(confirmed, keyframes[i].size).held_by(len(keyframes)))
    return result


def _photo(keyframe: Keyframe, intrinsics: np.ndarray, size: int) -> Photo:
    """The keyframe's picture with a longer side of at most `size` pixels."""
    grey = cv2.cvtColor(keyframe.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    height, width = grey.shape
    scale = min(1.0, size / max(height, width))
    small = (round(width * scale), round(height * scale))
    ratio = np.array([small[0] / width, small[1] / height] * 2)
    half = np.array([0.0, 0.0, 0.5, 0.5])  # a pixel's centre lies at whole numbers, the image's border half a pixel off
    scaled = (np.asarray(intrinsics, np.float64) + half) * ratio - half
    return Photo(cv2.resize(grey, small, interpolation=cv2.INTER_AREA), keyframe.pose, scaled)


def _search(points: np.ndarray, photo: Photo, others: Sequence[Photo], settings: StereoSettings) -> DepthMap | None:
    """The depth of one picture, not yet confirmed by others. points: float64 [n, 3], world, what the map knows."""
    planes = _planes(points, photo, settings.planes)
    if planes is None or not others:
        return None
    cost = matching_cost(photo, others, planes, settings.window)
    place, margin = (
        np.asarray(value)
        for value in semi_global(jnp.asarray(cost), jnp.asarray(photo.grey), smooth=settings.smooth, jump=settings.jump)
    )
    step = float(planes[1] - planes[0])
    inverse = (planes[0] + step * place).astype(np.float32)
    seen = support(photo, others, inverse, step, settings.window)
    good = (seen.views >= 1) & (margin > settings.margin) & (seen.sigma < LARGEST_SIGMA * inverse)
    nan = np.float32(np.nan)
    return DepthMap(
        np.where(good, 1.0 / inverse, nan).astype(np.float32),
        np.where(good, seen.sigma / inverse, nan).astype(np.float32),
        good.astype(np.float32),
    )


def _planes(points: np.ndarray, photo: Photo, count: int) -> np.ndarray | None:
    """Inverse depths to try: from 0.6 of the least to 1.5 of the largest that the map's points in view have."""
    local = points @ photo.pose[:3, :3].T + photo.pose[:3, 3]
    inside, _, _ = pinhole.visible(local, photo.intrinsics, (photo.grey.shape[0], photo.grey.shape[1]))
    if np.count_nonzero(inside) < LEAST_POINTS:
        return None
    low, high = np.quantile(1.0 / local[inside, 2], [0.02, 0.98])
    return np.linspace(0.6 * low, 1.5 * high, count)


def enlarged(depth_map: DepthMap, shape: Sequence[int]) -> DepthMap:
    """The depth map at the size of an image (height, width): interpolated on one surface, else the nearest."""
    size = (shape[1], shape[0])
    linear = cv2.resize(1.0 / depth_map.depth, size, interpolation=cv2.INTER_LINEAR)
    nearest, sigma, confidence = (
        cv2.resize(part, size, interpolation=cv2.INTER_NEAREST_EXACT)
        for part in (1.0 / depth_map.depth, depth_map.sigma, depth_map.confidence)
    )
    with np.errstate(invalid="ignore"):
        blend = np.abs(linear - nearest) < BLEND * nearest
    return DepthMap(1.0 / np.where(blend, linear, nearest), sigma, confidence)
