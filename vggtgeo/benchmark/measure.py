"""Compute errors and costs of a finished run as one row: SI units, degrees; None if undefined."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from vggtgeo.benchmark.inputs import ExactFrames, Input, exact_cloud
from vggtgeo.datasets.tanks import TanksAndTemples
from vggtgeo.evaluation import (
    CloudError,
    Similarity,
    cloud_error,
    comparability,
    depth_error,
    estimate_offsets,
    evaluate_trajectory,
    pose_consistency,
    surface_points,
)
from vggtgeo.evaluation.alignment import AXES, Axis
from vggtgeo.evaluation.pose_errors import Unit
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.report.map_scene import evenly_spaced
from vggtgeo.results.result import Result

DELTAS: tuple[tuple[str, float, Unit], ...] = (("1s", 1.0, "seconds"), ("1m", 1.0, "metres"))
"""Column suffix, delta and its unit of the relative errors, RTE and RRE."""
NOT_COMPARABLE = "not comparable"
"""Status of a row whose errors are meaningless, for the reasons in its message."""
_MARGIN = 0.02
"""Seconds before the first and after the last frame that still belong to the run's ground truth."""


def measure(result: Result, given: Input, spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row of a run, without columns that cannot be computed (errors without ground truth)."""
    summary = result.summary
    row: dict[str, Any] = {
        "verdict": result.verdict.level,
        "reasons": "; ".join(result.verdict.reasons),
        "metric": result.metric,
        "frames": summary["frames"],
        "tracked": summary["frames_tracked"],
        "keyframes": summary["keyframes"],
        "map_points": len(result.cloud),
        "frames_per_second": summary["frames_per_second"],
        "focal_error": focal_error(result.intrinsics_as_read, given.sequence.camera.intrinsics)
        if given.sequence.camera.known
        else None,
        **{f"seconds_{name.replace(' ', '_')}": value for name, value in summary["seconds_by_stage"].items()},
    }
    estimate = result.trajectory if spec["poses"] == "all" else result.keyframes
    truth = truth_of_run(result, given.truth)
    alignment = None
    if truth is not None:
        errors, alignment = trajectory_errors(estimate, truth, result.metric, vertical=spec["vertical"])
        row |= errors
    for name, reference in given.references.items():
        found, _ = trajectory_errors(estimate, reference, metric=False)
        row[f"ate_sim3_{name}_m"] = found.get("ate_sim3_m")
    if truth is not None and alignment is not None:
        row |= mean_nees(result, truth, row["scale"])
        row |= depth_errors(result, given, alignment) | map_errors(result, given, alignment, spec)
    return {name: _plain(value) for name, value in row.items()}


def focal_error(estimated: Sequence[float], true: Sequence[float]) -> float:
    """Return the relative error of the focal length, the mean over both axes; arguments are fx, fy, cx, cy, pixels."""
    return 0.5 * (estimated[0] / true[0] + estimated[1] / true[1]) - 1.0


def mean_nees(result: Result, truth: Trajectory, scale: float) -> dict[str, Any]:
    """Return the mean NEES of positions and of rotations, divided by its three degrees of freedom.

    It is 1 if the run's standard deviations match its errors, and larger if they are too small. scale: of the Sim(3)
    alignment, applied to a run of unknown scale.
    """
    stated = result.uncertainty
    if stated is None:
        return {}
    factor = 1.0 if result.metric else scale
    try:
        found = pose_consistency(result.trajectory, truth, factor * stated.translation, stated.rotation, factor)
    except InputError:
        return {}
    return {name: float(one.mean()) / 3 for name, one in zip(("nees_place", "nees_rotation"), found, strict=True)}


def truth_of_run(result: Result, truth: Trajectory | None) -> Trajectory | None:
    """Return the ground truth between the first and last frame of the run (all if no pose is); None if unknown."""
    if truth is None or result.record is None:
        return truth
    frames, times = result.record.slam.frames, truth.timestamps
    inside = (times >= frames[0].timestamp - _MARGIN) & (times <= frames[-1].timestamp + _MARGIN)
    return truth.select(inside) if inside.any() else truth


def trajectory_errors(
    estimate: Trajectory, truth: Trajectory, metric: bool = True, vertical: Axis = "z"
) -> tuple[dict[str, Any], Similarity | None]:
    """Return ATE after each alignment, RTE and RRE at `DELTAS`, and the alignment for maps.

    The alignment for maps and relative errors is SE(3) for a metric estimate, else Sim(3). If errors are meaningless,
    the row has a status and a message.
    """
    try:
        report = evaluate_trajectory(estimate, truth, vertical=AXES[vertical])
    except InputError as error:
        return {"warnings": str(error), "matched": 0}, None
    verdict = comparability(estimate, truth, metric=metric)
    offsets = estimate_offsets(estimate, truth)
    explained = [offsets.message] if offsets is not None and offsets.explains else []
    row: dict[str, Any] = {
        "matched": report.matched,
        "coverage": report.coverage,
        "path_m": truth.length,
        "ate_se3_m": report.se3.statistics.rmse,
        "ate_sim3_m": report.sim3.statistics.rmse,
        "ate_yaw_m": report.yaw.statistics.rmse,
        "ate_unaligned_m": report.unaligned.statistics.rmse,
        "ate_se3_max_m": report.se3.statistics.maximum,
        "scale": report.sim3.alignment.scale,
        "warnings": "; ".join([*report.warnings, *verdict.doubts, *explained]),
    }
    if offsets is not None:
        known = offsets.to_dict()
        row |= {"time_offset_s": known["time_offset_s"], "time_offset_sd_s": known["time_offset_s_sd"]}
        row |= {"offsets": ", ".join(offsets.significant), "ate_sim3_without_offsets_m": offsets.ate_left}
    if verdict.reasons:
        row |= {"status": NOT_COMPARABLE, "message": "; ".join([*verdict.reasons, *verdict.doubts, *explained])}
    for name, delta, unit in DELTAS:
        found = evaluate_trajectory(estimate, truth, delta=delta, unit=unit)
        pairs = found.relative if metric else found.relative_sim3
        row[f"rte_{name}_m"] = pairs.translation_statistics.mean
        row[f"rre_{name}_deg"] = float(np.degrees(pairs.rotation_statistics.mean))
    return row, (report.se3 if metric else report.sim3).alignment


def _plain(value: Any) -> Any:
    """Convert to a JSON type; None for NaN."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


_DEPTH_MAPS = 40  # keyframes whose depth is compared, evenly spaced: more change the mean little
_MAX_POINTS = 200_000
"""Points of each compared cloud: with a tenth of them the distances change in the third digit."""


def depth_errors(result: Result, given: Input, alignment: Similarity) -> dict[str, Any]:
    """Return errors of the keyframes' dense depth, and of their depth before the adjustment."""
    if given.exact is None or result.record is None:
        return {}
    pairs = list(zip(result.record.slam.keyframes, result.record.dense.depth_maps, strict=True))
    chosen = [pairs[row] for row in evenly_spaced(len(pairs), _DEPTH_MAPS)]
    fused = [(keyframe.frame, None if depth_map is None else depth_map.depth) for keyframe, depth_map in chosen]
    before = [(keyframe.frame, keyframe.depth) for keyframe, _ in chosen]
    return pooled_depth_errors(fused, before, given.exact, alignment.scale)


_Depths = Sequence[tuple[int, np.ndarray | None]]


def pooled_depth_errors(fused: _Depths, before: _Depths, exact: ExactFrames, scale: float) -> dict[str, Any]:
    """Return errors over all pixels of (frame index, depth) pairs, with depth multiplied by `scale`.

    `depth_prior_rmse_m` is the error of `before`. Exact depth is reduced by nearest neighbour to the size of the depth,
    which depends on `camera.max_pixels`.
    """
    resized = lambda truth, like: cv2.resize(truth, like.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    found, prior = (
        [
            depth_error((np.float32(scale) * depth).astype(np.float64), resized(exact.depth(frame), depth))
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


def map_errors(result: Result, given: Input, alignment: Similarity, spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return errors of the cloud, and of the mesh if the run saves it, after the alignment of the trajectory."""
    if not len(result.cloud):
        return {}
    threshold = spec["threshold"]
    points = alignment.points(result.cloud.points.astype(np.float64))
    if given.scan is not None:
        return scan_errors(points, given.scan, threshold)
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


def scan_errors(points: Float[np.ndarray, "n 3"], scan: TanksAndTemples, threshold: float) -> dict[str, Any]:
    """Return errors of the map (in the scan's frame) against a laser scan; empty without a scan.

    Both are cropped to the scan's volume and thinned to half the threshold, as in the benchmark Tanks and Temples, but
    without its refinement of the alignment.
    """
    truth = scan.scanned_points()
    if truth is None:
        return {}
    inside = points[scan.in_evaluation_volume(points)]
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
    shares = ("f_score", "precision", "recall")
    lengths = ("accuracy", "completeness", "mean_distance", "threshold")
    row = {name: getattr(found, name) for name in shares}
    return row | {f"{name}_m": getattr(found, name) for name in lengths}
