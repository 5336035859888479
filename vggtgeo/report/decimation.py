"""Fewer points and fewer faces, so that a page stays small."""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry.cells import cell_numbers
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud

_GROWTH = 1.2
"""Of the cells' edge from one try to the next."""


def decimated_cloud(cloud: PointCloud, max_points: int) -> PointCloud:
    """Return a random subset of at most `max_points` points in their old order; equal clouds give equal subsets."""
    if len(cloud) <= max_points:
        return cloud
    kept = np.sort(np.random.default_rng(0).choice(len(cloud), max_points, replace=False))
    part = lambda values: None if values is None else values[kept]
    return PointCloud(cloud.points[kept], cloud.colours[kept], part(cloud.confidence), part(cloud.normals))


def decimated_mesh(mesh: Mesh, max_faces: int) -> Mesh:
    """Return a mesh of at most `max_faces` faces: vertices in one cell of a grid become their mean, and faces that lose
    a corner disappear (J. Rossignac and P. Borrel, Multi-resolution 3D approximations, 1993).
    """
    if len(mesh.faces) <= max_faces:
        return mesh
    corners = mesh.vertices[mesh.faces[:: max(1, len(mesh.faces) // 10_000)]]
    edge = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    cell = max(edge, 1e-9) * np.sqrt(len(mesh.faces) / max_faces)
    while len((found := _clustered(mesh, cell)).faces) > max_faces:
        cell *= _GROWTH
    return found


def _clustered(mesh: Mesh, cell: float) -> Mesh:
    cells = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    _, group = np.unique(cell_numbers(cells), return_inverse=True)
    count = np.bincount(group)[:, None]
    mean = lambda values: (
        np.column_stack([np.bincount(group, column) for column in values.T.astype(np.float64)]) / count
    )
    faces = group[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    faces = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)  # same winding
    faces = np.unique(faces, axis=0)
    normals = mean(mesh.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(
        mean(mesh.vertices).astype(np.float32),
        faces.astype(np.int32),
        (normals / np.maximum(length, 1e-9)).astype(np.float32),
        np.rint(mean(mesh.colours)).astype(np.uint8),
    )
