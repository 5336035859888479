"""The errors and costs of a finished run, as one flat row of a table: SI units, degrees; None where there is none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.benchmark.inputs import Input, exact_cloud
from vggtgeo.evaluation import (
    DepthError,
    Similarity,
    TrajectoryReport,
    cloud_error,
    depth_error,
    evaluate_trajectory,
    focal_error,
)
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.results import Result

DELTAS: tuple[tuple[str, float, str], ...] = (("1s", 1.0, "seconds"), ("1m", 1.0, "metres"))
"""Of RTE and RRE: the name in the columns, how far, and its unit."""
_AROUND = 0.02
"""Seconds before the first and after the last frame in which the truth still belongs to the run."""
_DEPTH_MAPS = 40  # keyframes whose dense depth is compared, evenly spaced: more changes the mean by little


def measured(result: Result, given: Input, spec: Mapping[str, Any]) -> dict[str, Any]:
    """All of it. A number that a run cannot have (an error without truth) is left out."""
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
        errors, alignment = trajectory_errors(estimate, truth, result.metric)
        row |= errors
    for name, file in spec["references"].items():
        reference = Trajectory.load_tum(Path(spec["path"]) / file)
        found, _ = trajectory_errors(estimate, reference, metric=False)
        row[f"ate_sim3_{name}_m"] = found.get("ate_sim3_m")
    row |= depth_errors(result, given, alignment)
    if given.oracle is not None and alignment is not None and len(result.cloud):
        row |= cloud_errors(alignment.points(result.cloud.points.astype(np.float64)), given, spec["threshold"])
    return {name: _plain(value) for name, value in row.items()}


def truth_of_run(result: Result, truth: Trajectory | None) -> Trajectory | None:
    """The part of the truth that lies between the first and the last frame of the run; None where there is none."""
    if truth is None or result.record is None:
        return truth
    frames = result.record.slam.frames
    return between(truth, frames[0].timestamp, frames[-1].timestamp)


def between(truth: Trajectory, first: float, last: float) -> Trajectory:
    """The poses from `first` to `last`, seconds; all of them where none lies in between."""
    inside = (truth.timestamps >= first - _AROUND) & (truth.timestamps <= last + _AROUND)
    return truth.select(inside) if inside.any() else truth


def trajectory_errors(
    estimate: Trajectory, truth: Trajectory, metric: bool = True, max_dt: float = 0.01
) -> tuple[dict[str, Any], Similarity | None]:
    """ATE after each alignment, RTE and RRE at `DELTAS`; and the alignment that maps are compared after: SE(3) where
    lengths are metres, else Sim(3). Relative errors of an estimate without scale are taken after that, too.
    """
    try:
        report = evaluate_trajectory(estimate, truth, max_dt)
    except InputError as error:
        return {"warnings": str(error), "matched": 0}, None
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
        "warnings": "; ".join(report.warnings),
    }
    for name, delta, unit in DELTAS:
        row |= _relative(evaluate_trajectory(estimate, truth, max_dt, delta, unit=unit), name, metric)  # type: ignore[arg-type]
    return row, (report.se3 if metric else report.sim3).alignment


def _relative(report: TrajectoryReport, name: str, metric: bool) -> dict[str, Any]:
    pairs = report.relative if metric else report.relative_sim3
    return {
        f"rte_{name}_m": pairs.translation_statistics.mean,
        f"rre_{name}_deg": float(np.degrees(pairs.rotation_statistics.mean)),
    }


def depth_errors(result: Result, given: Input, alignment: Similarity | None) -> dict[str, Any]:
    """Pooled errors of the keyframes' dense depth, against the exact depth of a rendered walk.

    `depth_prior_rmse_m` is that of the depth before the adjustment. Depth without scale is scaled as the path is.
    """
    if given.oracle is None or result.record is None or alignment is None:
        return {}
    keyframes = result.record.slam.keyframes
    scale = np.float32(alignment.scale)
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, _DEPTH_MAPS).round().astype(int))
    found: list[DepthError] = []
    prior: list[DepthError] = []
    for number in chosen:
        keyframe, fused = keyframes[number], result.record.dense.depth_maps[number]
        truth = given.oracle.depth(keyframe.frame)
        for depth, kept in ((fused.depth if fused else None, found), (keyframe.depth, prior)):
            if depth is not None and np.isfinite(depth).any():
                kept.append(depth_error((scale * depth).astype(np.float64), truth))
    weights = np.array([one.count for one in found], np.float64)
    if not weights.sum():
        return {}
    pooled = lambda values: float(np.average(np.array(values), weights=weights))
    before = np.array([(one.rmse**2, one.count) for one in prior if one.count]).reshape(-1, 2)
    return {
        "depth_rmse_m": math.sqrt(pooled([one.rmse**2 for one in found])),
        "depth_abs_rel": pooled([one.relative for one in found]),
        "depth_below_1_25": pooled([one.inliers for one in found]),
        "depth_prior_rmse_m": math.sqrt(np.average(before[:, 0], weights=before[:, 1])) if len(before) else None,
    }


def cloud_errors(points: np.ndarray, given: Input, threshold: float) -> dict[str, Any]:
    """Precision, recall, F-score and mean distances of the map against the surfaces that the walk saw."""
    assert given.oracle is not None
    truth = exact_cloud(given.oracle)
    most = 200_000  # points of each: distances to a tenth of the map differ in the third digit
    step = max(len(points) // most, 1)
    found = cloud_error(points[::step], truth[:: max(len(truth) // most, 1)], threshold)
    return {
        "f_score": found.f_score,
        "precision": found.precision,
        "recall": found.recall,
        "accuracy_m": found.accuracy,
        "completeness_m": found.completeness,
        "mean_distance_m": found.mean_distance,
        "threshold_m": threshold,
    }


def _plain(value: Any) -> Any:
    """Of a type that JSON knows; None for NaN."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
