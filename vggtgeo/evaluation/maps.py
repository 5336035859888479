"""Errors of depth maps and point clouds; points on a mesh.

Source of the F-score: A. Knapitsch et al., "Tanks and Temples", ACM TOG 36(4), 2017.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_positive, check_whole, real_array, real_numbers


@dataclass(frozen=True)
class DepthError:
    """Fields: rmse and mean (of absolute values), metres; relative, the mean of |d - truth| / truth; inliers, share of
    pixels with max(d / truth, truth / d) < 1.25; count, pixels compared; coverage, their share of the pixels with
    ground truth. NaN if no pixel could be compared.
    """

    rmse: float
    mean: float
    relative: float
    inliers: float
    count: int
    coverage: float


def depth_error(depth: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"]) -> DepthError:
    """Return the errors of `depth` (metres, NaN = unknown) where it and `truth` are known.

    InputError if the shapes differ, or a known depth is not positive.
    """
    depth, truth = real_numbers("depth", depth), real_numbers("truth", truth)
    if depth.shape != truth.shape:
        raise InputError(f"`depth` has shape {depth.shape}, `truth` {truth.shape}; they must be equal")
    seen = np.isfinite(truth)
    both = seen & np.isfinite(depth)
    estimated, true = depth[both].astype(np.float64), truth[both].astype(np.float64)
    if (estimated <= 0).any() or (true <= 0).any():
        raise InputError("`depth` and `truth` must be positive, or NaN where depth is unknown")
    if not both.any():
        return DepthError(np.nan, np.nan, np.nan, np.nan, 0, 0.0 if seen.any() else np.nan)
    error = np.abs(estimated - true)
    ratio = np.maximum(estimated / true, true / estimated)
    return DepthError(
        rmse=float(np.sqrt(np.mean(error**2))),
        mean=float(error.mean()),
        relative=float(np.mean(error / true)),
        inliers=float(np.mean(ratio < 1.25)),
        count=int(both.sum()),
        coverage=float(both.sum() / seen.sum()),
    )


@dataclass(frozen=True)
class CloudError:
    """Fields:
    precision: share of the estimated points with a true point within `threshold`.
    recall: share of the true points with an estimated point within `threshold`.
    f_score: their harmonic mean (0 if both are 0).
    accuracy: mean distance from an estimated point to the nearest true one, metres.
    completeness: mean distance from a true point to the nearest estimated one, metres.
    threshold: metres.
    """

    precision: float
    recall: float
    f_score: float
    accuracy: float
    completeness: float
    threshold: float

    @property
    def mean_distance(self) -> float:
        """The mean of accuracy and completeness (Chamfer distance), metres."""
        return 0.5 * (self.accuracy + self.completeness)


def cloud_error(
    estimate: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "m 3"], threshold: float = 0.05
) -> CloudError:
    """Compare two clouds in one frame, metres, by nearest neighbours (k-d trees, O((n + m) log(n + m))).

    InputError for an empty cloud, NaN, other shapes, or a threshold that is not positive.
    """
    check_positive("threshold", threshold, "metres")
    estimate, truth = checked_points("estimate", estimate), checked_points("truth", truth)
    to_truth, _ = _tree(truth).query(estimate)
    to_estimate, _ = _tree(estimate).query(truth)
    precision, recall = float((to_truth <= threshold).mean()), float((to_estimate <= threshold).mean())
    total = precision + recall
    return CloudError(
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / total if total > 0 else 0.0,
        accuracy=float(to_truth.mean()),
        completeness=float(to_estimate.mean()),
        threshold=threshold,
    )


def checked_points(name: str, given: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the points as float64; raise InputError if there are none, or coordinates are invalid."""
    points = real_array(name, given, (None, 3)).astype(np.float64)
    if not len(points):
        raise InputError(f"`{name}` must be [n, 3], n at least 1, got shape {points.shape}")
    return points


def _tree(points: np.ndarray) -> cKDTree:
    """Return a k-d tree without duplicates: it cannot split equal points, and each query would visit all of them."""
    return cKDTree(np.unique(points, axis=0))


Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices, metres, and the vertex indices of each face."""


def surface_points(mesh: Mesh, spacing: float, seed: int = 0) -> Float[np.ndarray, "k 3"]:
    """Sample points on the faces of `mesh`, uniform by area, one per square of `spacing` metres on average.

    A face is drawn by its area, then a point in it: with u, v uniform in [0, 1] and s = sqrt(u), the point
    `(1 - s) a + s (1 - v) b + s v c` is uniform in the triangle (R. Osada et al., ACM TOG 21(4), 2002). InputError for
    wrong shapes, an invalid vertex index, a mesh without area, or a spacing that is not positive.
    """
    vertices, faces = _checked_mesh(mesh)
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


def _checked_mesh(mesh: Any) -> Mesh:
    vertices, faces = real_numbers("vertices of `mesh`", mesh[0]), real_numbers("faces of `mesh`", mesh[1])
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise InputError(
            f"`mesh` must have vertices and faces [n, 3], not empty, got shapes {vertices.shape} and {faces.shape}"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"`mesh` has {len(vertices)} vertices, but vertex indices from {faces.min()} to {faces.max()}")
    return checked_points("vertices of `mesh`", vertices), faces
