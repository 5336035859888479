"""Compute errors of depth maps and point clouds, and sample points on a mesh.

Source of the F-score: A. Knapitsch et al., "Tanks and Temples", ACM TOG 36(4), 2017.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from vggtgeo.io.errors import InputError


@dataclass(frozen=True)
class DepthError:
    """Errors of a depth map, NaN if no pixel could be compared.

    Fields: rmse, metres; relative, mean of |d - truth| / truth; inliers, share of pixels with
    max(d / truth, truth / d) < 1.25; count, number of compared pixels.
    """

    rmse: float
    relative: float
    inliers: float
    count: int


def depth_error(depth: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"]) -> DepthError:
    """Return the errors of `depth` (metres, positive, NaN = unknown) where it and `truth` are known."""
    both = np.isfinite(truth) & np.isfinite(depth)
    estimated, true = depth[both].astype(np.float64), truth[both].astype(np.float64)
    if not both.any():
        return DepthError(np.nan, np.nan, np.nan, 0)
    error = np.abs(estimated - true)
    ratio = np.maximum(estimated / true, true / estimated)
    return DepthError(
        rmse=float(np.sqrt(np.mean(error**2))),
        relative=float(np.mean(error / true)),
        inliers=float(np.mean(ratio < 1.25)),
        count=int(both.sum()),
    )


@dataclass(frozen=True)
class CloudError:
    """Errors of a point cloud.

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

    Raises InputError for an empty cloud.
    """
    for name, points in (("estimate", estimate), ("truth", truth)):
        if not len(points):
            raise InputError(f"`{name}` must have at least one point, got none")
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


def _tree(points: np.ndarray) -> cKDTree:
    """Return a k-d tree without duplicates, which it cannot separate, so that each query would visit all of them."""
    return cKDTree(np.unique(points, axis=0))


Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices, metres, and the vertex indices of each face."""


def surface_points(mesh: Mesh, spacing: float) -> Float[np.ndarray, "k 3"]:
    """Sample points on the faces of `mesh`, uniform by area, one per square of `spacing` metres on average.

    A face is drawn by its area, then a point in it: with u, v uniform in [0, 1] and s = sqrt(u), the point
    `(1 - s) a + s (1 - v) b + s v c` is uniform in the triangle (R. Osada et al., ACM TOG 21(4), 2002). Raises
    InputError for a mesh without area.
    """
    vertices, faces = mesh
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total = float(areas.sum())
    if not total > 0:
        raise InputError(f"`mesh` must have a positive area, got {total:g}")
    rng = np.random.default_rng(0)
    face = rng.choice(len(faces), max(round(total / spacing**2), 1), p=areas / total)
    s, v = np.sqrt(rng.random((len(face), 1))), rng.random((len(face), 1))
    return np.asarray((1 - s) * a[face] + s * (1 - v) * b[face] + s * v * c[face])
