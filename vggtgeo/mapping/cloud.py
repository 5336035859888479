"""The map: one point cloud of all keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.cells import cell_numbers
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.models import pinhole
from vggtgeo.slam.sparse_map.keyframe import Keyframe, read_at
from vggtgeo.slam.threads import map_in_threads

STEP = 3
"""Pixels between those of a depth map that become points: at 2.5 m and 500 pixels of focal length, 1.5 cm."""
LEAST_CONFIDENCE = 0.5
AGREE = 0.04
"""Largest relative difference of a point's depth from what another keyframe sees there."""
STEEP = 0.1
"""Relative difference of depth of pixels `STEP` apart above which they are no one surface and have no normal."""
TOGETHER = 64
"""Keyframes whose points are averaged before those of others are made: all points of one take 2 MB."""


@dataclass(frozen=True, eq=False)
class _Points:
    """Points, colours, normals (0 = not known), weights, and of how many points of keyframes each is the mean."""

    points: np.ndarray
    colours: np.ndarray
    normals: np.ndarray
    weight: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, colours: np.ndarray, normals: np.ndarray, weight: np.ndarray) -> _Points:
        """Of single points."""
        return cls(points, colours, normals, np.maximum(weight.astype(np.float64), 1e-6), np.ones(len(points)))

    @classmethod
    def joined(cls, parts: Sequence[_Points]) -> _Points:
        """One after the other."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


def map_points(
    keyframes: Sequence[Keyframe],
    intrinsics: np.ndarray,
    depth_maps: Sequence[DepthMap | None],
    *,
    voxel: float = 0.02,
) -> PointCloud:
    """One coloured cloud of all keyframes, in the world frame, with normals towards the cameras.

    Where a keyframe has dense depth: every third pixel whose confidence is at least one half and whose depth another
    keyframe confirms to 4 %; else the adjusted points alone. Points of one cell of `voxel` metres are averaged by their
    information.

    Args:
        keyframes: poses world -> camera.
        intrinsics: float64 [4], pixels.
        depth_maps: one a keyframe, None where there is none.
        voxel: edge of a cell, metres.

    """

    def part(i: int) -> _Points:
        if depth_maps[i] is None:
            return _sparse_points(keyframes[i], intrinsics)
        around = [j for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(keyframes) and depth_maps[j] is not None]
        return _dense_points(keyframes, depth_maps, i, around, intrinsics)

    groups = [range(len(keyframes))[first : first + TOGETHER] for first in range(0, len(keyframes), TOGETHER)]
    # Where there are points of several groups in a cell, their means are averaged once more.
    means = [_means_in_cells(_Points.joined(map_in_threads(part, group)), voxel) for group in groups]
    if not means or not sum(len(mean.points) for mean in means):
        nothing = np.zeros((0, 3))
        return PointCloud(nothing, nothing.astype(np.uint8), np.zeros(0, np.float32), nothing.astype(np.float32))
    found = means[0] if len(means) == 1 else _means_in_cells(_Points.joined(means), voxel)
    length = np.linalg.norm(found.normals, axis=1, keepdims=True)
    return PointCloud(
        found.points,
        found.colours.round().astype(np.uint8),
        (1 - 0.5**found.count).astype(np.float32),
        np.divide(found.normals, length, out=np.zeros_like(found.normals), where=length > 1e-6).astype(np.float32),
    )


def _sparse_points(keyframe: Keyframe, intrinsics: np.ndarray) -> _Points:
    slots = keyframe.points
    known = np.isfinite(slots.inverse_depth) & (slots.inverse_depth > 0.02)
    points = rigid.unproject(slots.pixels[known], slots.inverse_depth[known], keyframe.pose, intrinsics)
    colours = read_at(keyframe.image, slots.pixels[known])
    return _Points.of(points, colours, np.zeros((len(points), 3)), slots.confidence[known])


def _dense_points(
    keyframes: Sequence[Keyframe],
    depth_maps: Sequence[DepthMap | None],
    i: int,
    neighbours: Sequence[int],
    intrinsics: np.ndarray,
) -> _Points:
    """Points of keyframe i, those that a neighbour confirms where there is one."""
    keyframe, own = keyframes[i], depth_maps[i]
    assert own is not None
    own = own.opened()
    depth = own.depth[STEP // 2 :: STEP, STEP // 2 :: STEP]
    rows, columns = np.mgrid[STEP // 2 : own.depth.shape[0] : STEP, STEP // 2 : own.depth.shape[1] : STEP]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    with np.errstate(invalid="ignore"):
        points = rigid.unproject(pixels, 1.0 / depth.reshape(-1).astype(np.float64), keyframe.pose, intrinsics)
    normals = _normals(points.reshape(*depth.shape, 3), depth, rigid.centre(keyframe.pose)).reshape(-1, 3)
    rows, columns = rows.reshape(-1), columns.reshape(-1)
    good = np.isfinite(points[:, 0]) & (own.confidence[rows, columns] >= LEAST_CONFIDENCE)
    confirmed = np.zeros(len(points), bool)
    for j in neighbours:
        other = depth_maps[j]
        assert other is not None
        confirmed[good] |= _agrees(points[good], keyframes[j], other.depth, intrinsics)
    good &= confirmed if neighbours else True
    rows, columns = rows[good], columns[good]
    sigma = np.maximum(own.sigma[rows, columns] * own.depth[rows, columns], 1e-3).astype(np.float64)
    weight = own.confidence[rows, columns] / sigma**2
    return _Points.of(points[good], keyframe.image[rows, columns], normals[good], weight)


def _normals(points: np.ndarray, depth: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Unit normals [h, w, 3] of a grid of points, towards the camera; 0 where the neighbours are of no one surface."""
    normals = np.zeros_like(points)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    across = np.cross(down, right)
    length = np.linalg.norm(across, axis=-1)
    with np.errstate(invalid="ignore"):
        steep = np.maximum(np.abs(depth[1:-1, 2:] - depth[1:-1, :-2]), np.abs(depth[2:, 1:-1] - depth[:-2, 1:-1]))
        good = (length > 1e-12) & (steep < STEEP * depth[1:-1, 1:-1])
    unit = np.where(good[..., None], across / np.where(good, length, 1.0)[..., None], 0.0)
    with np.errstate(invalid="ignore"):
        behind = (unit * (centre - points[1:-1, 1:-1])).sum(-1) < 0
    normals[1:-1, 1:-1] = np.where(behind[..., None], -unit, unit)
    return normals


def _agrees(points: np.ndarray, keyframe: Keyframe, depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    local = points @ keyframe.pose[:3, :3].T + keyframe.pose[:3, 3]
    inside, rows, columns = pinhole.visible(local, intrinsics, (depth.shape[0], depth.shape[1]))
    z = local[inside, 2]
    with np.errstate(invalid="ignore"):
        inside[inside] = np.abs(depth[rows, columns] - z) < AGREE * z
    return inside


def _means_in_cells(given: _Points, voxel: float) -> _Points:
    """The mean of each cell, by weight."""
    cells = np.floor(given.points / voxel).astype(np.int64)
    _, group = np.unique(cell_numbers(cells), return_inverse=True)
    total = np.bincount(group, given.weight)
    mean = lambda values: np.column_stack([np.bincount(group, given.weight * column) / total for column in values.T])
    count = np.bincount(group, given.count)
    return _Points(mean(given.points), mean(given.colours.astype(np.float64)), mean(given.normals), total, count)
