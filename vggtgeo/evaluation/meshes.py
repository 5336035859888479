"""Comparison of triangle meshes by points sampled on their surfaces."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vggtgeo.evaluation.clouds import CloudError, checked_points, cloud_error
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_positive, check_whole, real_numbers

Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices, metres, and the vertex indices of each face."""


def surface_points(mesh: Mesh, spacing: float, seed: int = 0) -> Float[np.ndarray, "k 3"]:
    """Sample points on the faces of `mesh`, uniform by area, one per square of `spacing` metres on average.

    A face is drawn by its area, then a point in it: with u, v uniform in [0, 1] and s = sqrt(u), the point
    `(1 - s) a + s (1 - v) b + s v c` is uniform in the triangle (R. Osada et al., ACM TOG 21(4), 2002). InputError for
    wrong shapes, an invalid vertex index, a mesh without area, or a spacing that is not positive.
    """
    vertices, faces = _checked(mesh)
    check_positive("spacing", spacing, "metres")
    check_whole("seed", seed)
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total = float(areas.sum())
    if not total > 0:
        raise InputError("`mesh` has no face with an area")
    rng = np.random.default_rng(seed)
    face = rng.choice(len(faces), max(round(total / spacing**2), 1), p=areas / total)
    s, v = np.sqrt(rng.random((len(face), 1))), rng.random((len(face), 1))
    return np.asarray((1 - s) * a[face] + s * (1 - v) * b[face] + s * v * c[face])


def mesh_error(estimate: Mesh, truth: Mesh, threshold: float = 0.05, seed: int = 0) -> CloudError:
    """Return the `cloud_error` of points sampled on both surfaces, a fifth of the threshold apart.

    At this spacing a distance to the nearest sample exceeds that to the surface by a few per cent of the threshold.
    """
    check_positive("threshold", threshold, "metres")
    spacing = threshold / 5
    return cloud_error(surface_points(estimate, spacing, seed), surface_points(truth, spacing, seed + 1), threshold)


def _checked(mesh: Any) -> Mesh:
    vertices, faces = real_numbers("vertices of `mesh`", mesh[0]), real_numbers("faces of `mesh`", mesh[1])
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise InputError(
            f"`mesh` must have vertices and faces [n, 3], not empty, got shapes {vertices.shape} and {faces.shape}"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"`mesh` has {len(vertices)} vertices, but vertex indices from {faces.min()} to {faces.max()}")
    return checked_points("vertices of `mesh`", vertices), faces
