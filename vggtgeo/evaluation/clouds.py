"""Comparison of point clouds: precision, recall, F-score, mean distances.

Source of the F-score: A. Knapitsch et al., "Tanks and Temples", ACM TOG 36(4), 2017.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_positive, real_array


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
