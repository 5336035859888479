"""The map: one point cloud of all keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.models import pinhole
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.keyframe_depth import fused_depths

_Weighted = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Points, colours, weights."""


def map_points(
    keyframes: Sequence[Keyframe],
    intrinsics: np.ndarray,
    depths: Sequence[np.ndarray | None] | None = None,
    *,
    voxel: float = 0.02,
    least_confidence: float = 0.5,
) -> PointCloud:
    """One coloured cloud of all keyframes, in the world frame.

    depths: the keyframes' `fused_depths`, where they are at hand.


    Where there is metric depth: every third pixel whose confidence is at least `least_confidence` and whose depth
    another keyframe confirms to 4 %; else the adjusted points alone. Points of one cell of `voxel` metres are averaged.
    """
    metric = [bool(np.isfinite(keyframe.depth).any()) for keyframe in keyframes]
    depths = fused_depths(keyframes, intrinsics) if depths is None else depths
    parts = []
    for i, keyframe in enumerate(keyframes):
        if not metric[i]:
            parts.append(_sparse_points(keyframe, intrinsics))
            continue
        neighbours = [j for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(keyframes) and metric[j]]
        parts.append(_dense_points(keyframes, depths, i, neighbours, intrinsics, least_confidence))
    points, colours, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _average_in_voxels(points, colours, weight, voxel)


def _sparse_points(keyframe: Keyframe, intrinsics: np.ndarray) -> _Weighted:
    slots = keyframe.points
    known = np.isfinite(slots.inverse_depth) & (slots.inverse_depth > 0.02)
    points = rigid.unproject(slots.pixels[known], slots.inverse_depth[known], keyframe.pose, intrinsics)
    columns, rows = np.rint(slots.pixels[known]).astype(int).T
    return points, keyframe.image[rows, columns], slots.confidence[known]


def _dense_points(
    keyframes: Sequence[Keyframe],
    depths: Sequence[np.ndarray | None],
    i: int,
    neighbours: Sequence[int],
    intrinsics: np.ndarray,
    least_confidence: float,
    step: int = 3,
) -> _Weighted:
    """Points, colours and weights of keyframe i; `depths[k]` is None where keyframe k has no metric depth."""
    keyframe, depth = keyframes[i], depths[i]
    assert depth is not None
    rows, columns = np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step].reshape(2, -1)
    confidence = keyframe.depth_confidence[rows, columns] / 255.0
    good = np.isfinite(depth[rows, columns]) & (confidence >= least_confidence)
    rows, columns, confidence = rows[good], columns[good], confidence[good]
    pixels = np.column_stack([columns, rows]).astype(np.float64)
    points = rigid.unproject(pixels, 1.0 / depth[rows, columns].astype(np.float64), keyframe.pose, intrinsics)
    confirmed = np.zeros(len(points), bool)
    for j in neighbours:
        other = depths[j]
        if other is not None:
            confirmed |= _agrees(points, keyframes[j], other, intrinsics)
    if neighbours:
        points, confidence = points[confirmed], confidence[confirmed]
        rows, columns = rows[confirmed], columns[confirmed]
    # Near measurements are better: the noise of a depth sensor grows with the square of the distance.
    z = depth[rows, columns]
    return points, keyframe.image[rows, columns], confidence / np.maximum(z, 0.3) ** 2


def _agrees(points: np.ndarray, keyframe: Keyframe, depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    local = points @ keyframe.pose[:3, :3].T + keyframe.pose[:3, 3]
    inside, rows, columns = pinhole.visible(local, intrinsics, depth.shape)
    z = local[inside, 2]
    with np.errstate(invalid="ignore"):
        inside[inside] = np.abs(depth[rows, columns] - z) < 0.04 * z
    return inside


def _average_in_voxels(points: np.ndarray, colours: np.ndarray, weight: np.ndarray, voxel: float) -> PointCloud:
    if not len(points):
        return PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32))
    cells = np.floor(points / voxel).astype(np.int64)
    _, group = np.unique(cells, axis=0, return_inverse=True)
    group = group.reshape(-1)
    weight = np.maximum(weight.astype(np.float64), 1e-6)
    total = np.bincount(group, weight)
    mean = lambda values: np.column_stack([np.bincount(group, weight * column) / total for column in values.T])
    count = np.bincount(group)
    return PointCloud(
        mean(points), mean(colours.astype(np.float64)).round().astype(np.uint8), (1 - 0.5**count).astype(np.float32)
    )
