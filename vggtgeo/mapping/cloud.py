"""The point cloud of a map: dense depth of all keyframes, averaged in voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.point_cloud import PointCloud, cell_numbers
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.threads import map_in_threads

STEP = 3
"""Pixels between the sampled ones of a depth map: 1.5 cm at 2.5 m and 500 pixels focal length."""
MIN_CONFIDENCE = 0.5
MAX_DIFFERENCE = 0.04
"""Largest relative difference of depth between a point and a keyframe that confirms it."""
MAX_STEP = 0.1
"""Relative difference of depth of neighbouring samples above which they are on different surfaces: no normal."""
BATCH = 16
"""Keyframes whose points are averaged at a time: the points of one take 2 MB."""


@dataclass(frozen=True, eq=False)
class _Points:
    """Points, colours, normals (0 = unknown), weights, and number of samples in each mean."""

    points: np.ndarray
    colours: np.ndarray
    normals: np.ndarray
    weight: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, colours: np.ndarray, normals: np.ndarray, weight: np.ndarray) -> _Points:
        """Return points of one sample each."""
        return cls(points, colours, normals, np.maximum(weight.astype(np.float64), 1e-6), np.ones(len(points)))

    @classmethod
    def joined(cls, parts: Sequence[_Points]) -> _Points:
        """Concatenate."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


def map_points(
    keyframes: Sequence[Keyframe],
    intrinsics: np.ndarray,
    depth_maps: Sequence[DepthMap | None],
    *,
    voxel: float = 0.02,
) -> PointCloud:
    """Return a coloured cloud of all keyframes, world frame, with normals towards the cameras.

    Of a keyframe with dense depth, every third pixel is used if its confidence is at least 0.5 and a neighbouring
    keyframe confirms its depth to 4 %; of others, the adjusted points. Points in a voxel are averaged, weighted by
    information.

    Args:
        keyframes: poses world -> camera.
        intrinsics: float64 [4], pixels.
        depth_maps: one per keyframe, None if unknown.
        voxel: edge of a voxel, metres.

    """

    def part(i: int) -> _Points:
        if depth_maps[i] is None:
            return _sparse_points(keyframes[i], intrinsics)
        around = [j for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(keyframes) and depth_maps[j] is not None]
        return _dense_points(keyframes, depth_maps, i, around, intrinsics)

    batches = [range(len(keyframes))[first : first + BATCH] for first in range(0, len(keyframes), BATCH)]
    # A voxel with points of several batches is averaged again below.
    means = [_voxel_means(_Points.joined(map_in_threads(part, batch)), voxel) for batch in batches]
    if not means or not sum(len(mean.points) for mean in means):
        empty = np.zeros((0, 3))
        return PointCloud(empty, empty.astype(np.uint8), np.zeros(0, np.float32), empty.astype(np.float32))
    found = means[0] if len(means) == 1 else _voxel_means(_Points.joined(means), voxel)
    length = np.linalg.norm(found.normals, axis=1, keepdims=True)
    return PointCloud(
        found.points,
        found.colours.round().astype(np.uint8),
        (1 - 0.5**found.count).astype(np.float32),
        np.divide(found.normals, length, out=np.zeros_like(found.normals), where=length > 1e-6).astype(np.float32),
    )


def _sparse_points(keyframe: Keyframe, intrinsics: np.ndarray) -> _Points:
    slots = keyframe.points
    known = slots.determined & (slots.inverse_depth > 0.02)
    points = rigid.unproject(slots.pixels[known], slots.inverse_depth[known], keyframe.pose, intrinsics)
    colours = pinhole.at_pixels(keyframe.image, slots.pixels[known])
    return _Points.of(points, colours, np.zeros((len(points), 3)), slots.confidence[known])


def _dense_points(
    keyframes: Sequence[Keyframe],
    depth_maps: Sequence[DepthMap | None],
    i: int,
    neighbours: Sequence[int],
    intrinsics: np.ndarray,
) -> _Points:
    """Return points of keyframe i that a neighbour confirms; all of them without neighbours."""
    keyframe, own = keyframes[i], depth_maps[i]
    assert own is not None
    own = own.decoded()
    depth = own.depth[STEP // 2 :: STEP, STEP // 2 :: STEP]
    rows, columns = np.mgrid[STEP // 2 : own.depth.shape[0] : STEP, STEP // 2 : own.depth.shape[1] : STEP]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    with np.errstate(invalid="ignore"):
        points = rigid.unproject(pixels, 1.0 / depth.reshape(-1).astype(np.float64), keyframe.pose, intrinsics)
    normals = _normals(points.reshape(*depth.shape, 3), depth, rigid.centre(keyframe.pose)).reshape(-1, 3)
    rows, columns = rows.reshape(-1), columns.reshape(-1)
    good = np.isfinite(points[:, 0]) & (own.confidence[rows, columns] >= MIN_CONFIDENCE)
    confirmed = np.zeros(len(points), bool)
    for j in neighbours:
        other = depth_maps[j]
        assert other is not None
        confirmed[good] |= _confirmed(points[good], keyframes[j], other.depth, intrinsics)
    # Without neighbours there is no second opinion, and a map of one keyframe would be empty.
    good &= confirmed if neighbours else True
    rows, columns = rows[good], columns[good]
    sigma = np.maximum(own.sigma[rows, columns] * own.depth[rows, columns], 1e-3).astype(np.float64)
    # Information of the depth; the bound of a millimetre keeps one sample from dominating its voxel.
    weight = own.confidence[rows, columns] / sigma**2
    return _Points.of(points[good], keyframe.image[rows, columns], normals[good], weight)


def _normals(points: np.ndarray, depth: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return unit normals [h, w, 3] of a grid of points, towards the camera; 0 at depth edges."""
    normals = np.zeros_like(points)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    across = np.cross(down, right)
    length = np.linalg.norm(across, axis=-1)
    with np.errstate(invalid="ignore"):
        step = np.maximum(np.abs(depth[1:-1, 2:] - depth[1:-1, :-2]), np.abs(depth[2:, 1:-1] - depth[:-2, 1:-1]))
        good = (length > 1e-12) & (step < MAX_STEP * depth[1:-1, 1:-1])
    unit = np.where(good[..., None], across / np.where(good, length, 1.0)[..., None], 0.0)
    with np.errstate(invalid="ignore"):
        behind = (unit * (centre - points[1:-1, 1:-1])).sum(-1) < 0
    normals[1:-1, 1:-1] = np.where(behind[..., None], -unit, unit)
    return normals


def _confirmed(points: np.ndarray, keyframe: Keyframe, depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    local = points @ keyframe.pose[:3, :3].T + keyframe.pose[:3, 3]
    inside, rows, columns = pinhole.visible(local, intrinsics, (depth.shape[0], depth.shape[1]))
    z = local[inside, 2]
    with np.errstate(invalid="ignore"):
        inside[inside] = np.abs(depth[rows, columns] - z) < MAX_DIFFERENCE * z
    return inside


def _voxel_means(samples: _Points, voxel: float) -> _Points:
    """Return the weighted mean of each voxel."""
    cells = np.floor(samples.points / voxel).astype(np.int64)
    _, group = np.unique(cell_numbers(cells), return_inverse=True)
    total = np.bincount(group, samples.weight)
    mean = lambda values: np.column_stack([np.bincount(group, samples.weight * column) / total for column in values.T])
    count = np.bincount(group, samples.count)
    return _Points(mean(samples.points), mean(samples.colours.astype(np.float64)), mean(samples.normals), total, count)
