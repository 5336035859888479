"""Errors of depth, point cloud and mesh of a run against exact depth or a laser scan."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from vggtgeo.benchmark.exact_frames import ExactFrames, exact_cloud
from vggtgeo.benchmark.inputs import Input
from vggtgeo.evaluation import CloudError, Similarity, cloud_error, depth_error, surface_points
from vggtgeo.results.result import Result

_DEPTH_MAPS = 40  # keyframes whose depth is compared, evenly spaced: more change the mean little
_MAX_POINTS = 200_000
"""Of each cloud: a tenth of the points changes the distances in the third digit."""


def depth_errors(result: Result, given: Input, alignment: Similarity) -> dict[str, Any]:
    """Return errors of the keyframes' dense depth, and of their depth before the adjustment."""
    if given.exact is None or result.record is None:
        return {}
    keyframes, maps = result.record.slam.keyframes, result.record.dense.depth_maps
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, _DEPTH_MAPS).round().astype(int))
    fused = [(keyframes[row].frame, maps[row].depth if maps[row] is not None else None) for row in chosen]
    before = [(keyframes[row].frame, keyframes[row].depth) for row in chosen]
    return pooled_depth_errors(fused, before, given.exact, alignment.scale)


_Depths = Sequence[tuple[int, np.ndarray | None]]


def pooled_depth_errors(fused: _Depths, before: _Depths, exact: ExactFrames, scale: float) -> dict[str, Any]:
    """Return errors over all pixels of (frame index, depth) pairs, with depth multiplied by `scale`.

    `depth_prior_rmse_m` is that of `before`. Exact depth is reduced to the size of the depth by nearest neighbour
    (`camera.max_pixels`).
    """
    found, prior = (
        [
            depth_error((np.float32(scale) * depth).astype(np.float64), _as_large(exact.depth(frame), depth.shape))
            for frame, depth in pairs
            if depth is not None and np.isfinite(depth).any()
        ]
        for pairs in (fused, before)
    )
    weights = np.array([one.count for one in found], np.float64)
    if not weights.sum():
        return {}
    pooled = lambda values: float(np.average(np.array(values), weights=weights))
    known = np.array([(one.rmse**2, one.count) for one in prior if one.count]).reshape(-1, 2)
    return {
        "depth_rmse_m": math.sqrt(pooled([one.rmse**2 for one in found])),
        "depth_abs_rel": pooled([one.relative for one in found]),
        "depth_below_1_25": pooled([one.inliers for one in found]),
        "depth_prior_rmse_m": math.sqrt(np.average(known[:, 0], weights=known[:, 1])) if len(known) else None,
    }


def _as_large(truth: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if truth.shape == shape:
        return truth
    return np.asarray(cv2.resize(truth, shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT), np.float64)


def map_errors(result: Result, given: Input, alignment: Similarity, spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return errors of the cloud, and of the mesh if the run saves it, after the alignment of the trajectory."""
    if not len(result.cloud):
        return {}
    threshold = spec["threshold"]
    points = alignment.points(result.cloud.points.astype(np.float64))
    if given.scan is not None:
        return scan_errors(points, given, threshold)
    if given.exact is None:
        return {}
    truth = _sparse(exact_cloud(given.exact))
    row = _columns(cloud_error(_sparse(points), truth, threshold))
    if spec["pages"] and result.mesh is not None and len(result.mesh.faces):
        vertices = alignment.points(result.mesh.vertices.astype(np.float64))
        surface = _sparse(surface_points((vertices, result.mesh.faces), threshold / 5))
        found = cloud_error(surface, truth, threshold)
        row |= {"mesh_f_score": found.f_score, "mesh_accuracy_m": found.accuracy}
        row |= {"mesh_completeness_m": found.completeness}
    return row


def scan_errors(points: Float[np.ndarray, "n 3"], given: Input, threshold: float) -> dict[str, Any]:
    """Return errors of the map (in the scan's frame) against a laser scan; empty without a scan.

    Both are cropped to the scan's volume and thinned to half the threshold, as in the benchmark Tanks and Temples, but
    without its refinement of the alignment.
    """
    truth = None if given.scan is None else given.scan.scanned_points()
    if given.scan is None or truth is None:
        return {}
    inside = points[given.scan.judged(points)]
    if not len(inside):
        return {"f_score": 0.0, "precision": 0.0, "recall": 0.0, "threshold_m": threshold}
    return _columns(cloud_error(thinned(inside, threshold / 2), thinned(truth, threshold / 2), threshold))


def thinned(points: Float[np.ndarray, "n 3"], size: float) -> Float[np.ndarray, "m 3"]:
    """Return one point of each occupied cube of `size` metres."""
    _, rows = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(rows)]


def _sparse(points: np.ndarray) -> np.ndarray:
    return points[:: max(len(points) // _MAX_POINTS, 1)]


def _columns(found: CloudError) -> dict[str, Any]:
    return {
        "f_score": found.f_score,
        "precision": found.precision,
        "recall": found.recall,
        "accuracy_m": found.accuracy,
        "completeness_m": found.completeness,
        "mean_distance_m": found.mean_distance,
        "threshold_m": found.threshold,
    }
