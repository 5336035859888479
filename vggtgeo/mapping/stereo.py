"""Multi-view stereo: dense depth of each keyframe from images and adjusted poses.

Steps: view selection, plane sweep (`plane_sweep.py`), semi-global matching (`semi_global.py`),
standard deviations (`uncertainty.py`), and the check that neighbours confirm the depth (`depth_map.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import jax.numpy as jnp
import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.mapping.depth_map import DepthMap, PosedDepth, confirm
from vggtgeo.mapping.plane_sweep import Photo, matching_cost
from vggtgeo.mapping.semi_global import semi_global
from vggtgeo.mapping.uncertainty import stereo_depth_sigma
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.threads import map_in_threads

MIN_POINTS = 8
"""Known points in view needed to set the range of depths of the search."""
MAX_SIGMA = 0.05
"""Largest relative standard deviation of a depth: worse ones would only blur the map."""
MAX_BLEND = 0.03
"""Relative difference of neighbouring depths up to which upsampling interpolates between them."""


VIEWS = 6
"""Largest number of neighbours."""
PLANES = 96
"""Number of depths of the search."""
SEARCH_SIZE = 320
"""Longer side of the images in the search, pixels."""
WINDOW = 7
"""Width of the correlation window there, pixels, odd."""
SMOOTH, JUMP = 0.04, 0.5
"""Penalties of the semi-global matching, in units of 1 - correlation."""
MIN_MARGIN = 0.02
"""Of a pixel's plane, same unit."""
MIN_VIEWS = 2
"""Neighbours that must confirm a depth."""


def stereo_depths(keyframes: Sequence[Keyframe], intrinsics: np.ndarray) -> list[DepthMap | None]:
    """Return the depth of each keyframe from its neighbours' images; None if no neighbour overlaps.

    Args:
        keyframes: adjusted; poses world -> camera.
        intrinsics: float64 [4], pixels.

    """
    views = choose_views(keyframes, intrinsics)
    photos = [_photo(keyframe, intrinsics) for keyframe in keyframes]
    points = [known_points(keyframe, intrinsics) for keyframe in keyframes]

    def search(i: int) -> PosedDepth | None:
        around = np.concatenate([points[j] for j in (i, *views[i])])
        depth_map = _search(around, photos[i], [photos[j] for j in views[i]])
        if depth_map is None:
            return None
        return PosedDepth(depth_map.compressed_for(len(photos)), photos[i].pose, photos[i].intrinsics)

    found = map_in_threads(search, range(len(photos)))  # about 150 MB per search
    result: list[DepthMap | None] = []
    for i, own in enumerate(found):
        others = [other for j in views[i] if (other := found[j]) is not None]
        confirmed = None if own is None else confirm(own, others, MIN_VIEWS)
        if confirmed is None or confirmed.empty:
            result.append(None)
        else:
            result.append(upsample(confirmed, keyframes[i].size).compressed_for(len(keyframes)))
    return result


def _photo(keyframe: Keyframe, intrinsics: np.ndarray) -> Photo:
    """Return the keyframe's image, reduced to a longer side of at most `SEARCH_SIZE` pixels."""
    grey = cv2.cvtColor(keyframe.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    height, width = grey.shape
    scale = min(1.0, SEARCH_SIZE / max(height, width))
    small = (round(width * scale), round(height * scale))
    ratio = np.array([small[0] / width, small[1] / height] * 2)
    half = np.array([0.0, 0.0, 0.5, 0.5])  # pixel centres are integers, so that the image begins at -0.5
    scaled = (np.asarray(intrinsics, np.float64) + half) * ratio - half
    return Photo(cv2.resize(grey, small, interpolation=cv2.INTER_AREA), keyframe.pose, scaled)


def _search(points: np.ndarray, photo: Photo, others: Sequence[Photo]) -> DepthMap | None:
    """Return the depth of one image, before it is confirmed by others. points: float64 [n, 3], world, sets the range of
    depths.
    """
    planes = _planes(points, photo)
    if planes is None or not others:
        return None
    cost = matching_cost(photo, others, planes, WINDOW)
    matched = semi_global(jnp.asarray(cost), jnp.asarray(photo.grey), smooth=SMOOTH, jump=JUMP)
    position, margin = (np.asarray(value) for value in matched)
    step = float(planes[1] - planes[0])
    inverse = (planes[0] + step * position).astype(np.float32)
    sigma, views = stereo_depth_sigma(photo, others, inverse, step, WINDOW)
    good = (views >= 1) & (margin > MIN_MARGIN) & (sigma < MAX_SIGMA * inverse)
    nan = np.float32(np.nan)
    return DepthMap(
        np.where(good, 1.0 / inverse, nan).astype(np.float32),
        np.where(good, sigma / inverse, nan).astype(np.float32),
        good.astype(np.float32),
    )


def _planes(points: np.ndarray, photo: Photo) -> np.ndarray | None:
    """Return inverse depths of the planes, 0.6 of the smallest to 1.5 of the largest of the points in view."""
    local = points @ photo.pose[:3, :3].T + photo.pose[:3, 3]
    inside, _, _ = pinhole.visible(local, photo.intrinsics, (photo.grey.shape[0], photo.grey.shape[1]))
    if np.count_nonzero(inside) < MIN_POINTS:
        return None
    # Quantiles, since a few points are outliers; the margins leave room for surfaces without key points.
    low, high = np.quantile(1.0 / local[inside, 2], [0.02, 0.98])
    # Equal steps in inverse depth are about equal steps in the image.
    return np.linspace(0.6 * low, 1.5 * high, PLANES)


def upsample(depth_map: DepthMap, shape: Sequence[int]) -> DepthMap:
    """Return the depth map at (height, width): interpolated on one surface, nearest neighbour at depth edges."""
    size = (shape[1], shape[0])
    # Inverse depth is affine in the pixel on a plane, where this interpolation is therefore exact.
    linear = cv2.resize(1.0 / depth_map.depth, size, interpolation=cv2.INTER_LINEAR)
    nearest, sigma, confidence = (
        cv2.resize(part, size, interpolation=cv2.INTER_NEAREST_EXACT)
        for part in (1.0 / depth_map.depth, depth_map.sigma, depth_map.confidence)
    )
    with np.errstate(invalid="ignore"):
        blend = np.abs(linear - nearest) < MAX_BLEND * nearest
    return DepthMap(1.0 / np.where(blend, linear, nearest), sigma, confidence)


GOOD_ANGLE = np.radians(3.0)
"""Triangulation angle from which the weight is 1: below it depth is uncertain."""
WIDE_ANGLE = np.radians(12.0)
"""Above it the weight falls: windows on slanted surfaces, such as floors, look too different."""
MIN_SCORE = 0.08
"""Neighbours with a lower score are left out."""
MAX_POINTS = 150
"""Points that are scored, of a keyframe's: a sample, for speed."""


def known_points(keyframe: Keyframe, intrinsics: np.ndarray) -> np.ndarray:
    """Return the keyframe's key points and line samples of known depth as world points, float64 [n, 3]."""
    parts = []
    for slots in (keyframe.points, keyframe.samples):
        known = slots.determined & (slots.inverse_depth > 0.02)
        parts.append(rigid.unproject(slots.pixels[known], slots.inverse_depth[known], keyframe.pose, intrinsics))
    return np.concatenate(parts)


def choose_views(keyframes: Sequence[Keyframe], intrinsics: np.ndarray) -> list[tuple[int, ...]]:
    """Return for each keyframe the indices in `keyframes` of its best neighbours, at most `VIEWS`, best first.

    The score of a neighbour is the mean weight of the keyframe's known points: 0 where the point is not visible, else
    rising with the triangulation angle to `GOOD_ANGLE` and falling beyond `WIDE_ANGLE`, as in COLMAP's view selection
    (Schoenberger et al., "Pixelwise view selection for unstructured multi-view stereo", ECCV 2016).
    """
    centres = np.array([rigid.centre(keyframe.pose) for keyframe in keyframes]).reshape(-1, 3)
    chosen: list[tuple[int, ...]] = []
    for i, keyframe in enumerate(keyframes):
        points = known_points(keyframe, intrinsics)
        points = points[:: max(1, len(points) // MAX_POINTS)]
        if not len(points):
            chosen.append(())
            continue
        # A baseline longer than the median depth gives angles beyond `WIDE_ANGLE`: such keyframes are not scored.
        depth = float(np.median(np.linalg.norm(points - centres[i], axis=1)))
        near = np.nonzero(np.linalg.norm(centres - centres[i], axis=1) < depth)[0]
        scores = {j: _score(points, centres[i], keyframes[j], intrinsics) for j in near.tolist() if j != i}
        ranked = sorted(scores, key=lambda j: -scores[j])
        chosen.append(tuple(j for j in ranked[:VIEWS] if scores[j] > MIN_SCORE))
    return chosen


def _score(points: np.ndarray, centre: np.ndarray, other: Keyframe, intrinsics: np.ndarray) -> float:
    local = points @ other.pose[:3, :3].T + other.pose[:3, 3]
    inside, _, _ = pinhole.visible(local, intrinsics, other.size)
    first, second = points - centre, points - rigid.centre(other.pose)
    cosine = (first * second).sum(1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))
    angle = np.arccos(np.clip(cosine, -1, 1))
    weight = np.minimum(angle / GOOD_ANGLE, 1.0) * np.exp(-(np.maximum(angle / WIDE_ANGLE - 1.0, 0.0) ** 2))
    return float(np.mean(np.where(inside, weight, 0.0)))
