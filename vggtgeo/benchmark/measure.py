"""The errors and costs of a finished run, as one flat row of a table: SI units, degrees; None where there is none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vggtgeo.benchmark.inputs import Input
from vggtgeo.benchmark.map_errors import depth_errors, map_errors
from vggtgeo.evaluation import (
    Similarity,
    TrajectoryReport,
    comparability,
    estimate_offsets,
    evaluate_trajectory,
    focal_error,
    pose_consistency,
)
from vggtgeo.evaluation.alignment import AXES, Axis
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.results.result import Result

DELTAS: tuple[tuple[str, float, str], ...] = (("1s", 1.0, "seconds"), ("1m", 1.0, "metres"))
"""Of RTE and RRE: the name in the columns, how far, and its unit."""
NOT_COMPARABLE = "not comparable"
"""The status of a row whose errors mean nothing, for the reasons in its message."""
_AROUND = 0.02
"""Seconds before the first and after the last frame in which the truth still belongs to the run."""


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
        errors, alignment = trajectory_errors(estimate, truth, result.metric, vertical=spec["vertical"])
        row |= errors
    for name, reference in given.references.items():
        found, _ = trajectory_errors(estimate, reference, metric=False)
        row[f"ate_sim3_{name}_m"] = found.get("ate_sim3_m")
    if truth is not None and alignment is not None:
        row |= honesty(result, truth, row["scale"])
        row |= depth_errors(result, given, alignment) | map_errors(result, given, alignment, spec)
    return {name: _plain(value) for name, value in row.items()}


def honesty(result: Result, truth: Trajectory, scale: float, max_dt: float = 0.01) -> dict[str, Any]:
    """The mean NEES of places and of rotations, over their three numbers each: 1 where the deviations that the run
    states are those of its errors, more where they are too small. scale: of the Sim(3) alignment, which lengths of a
    run without metres are taken by.
    """
    stated = result.uncertainty
    if stated is None:
        return {}
    factor = 1.0 if result.metric else scale
    try:
        found = pose_consistency(
            result.trajectory, truth, factor * stated.translation, stated.rotation, factor, max_dt=max_dt
        )
    except InputError:
        return {}
    return {name: one.mean / one.degrees for name, one in zip(("nees_place", "nees_rotation"), found, strict=True)}


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
    estimate: Trajectory, truth: Trajectory, metric: bool = True, max_dt: float = 0.01, vertical: Axis = "z"
) -> tuple[dict[str, Any], Similarity | None]:
    """ATE after each alignment, RTE and RRE at `DELTAS`; and the alignment that maps are compared after: SE(3) where
    lengths are metres, else Sim(3). Relative errors of an estimate without scale are taken after that, too. A status
    and a message where the errors mean nothing.
    """
    try:
        report = evaluate_trajectory(estimate, truth, max_dt, vertical=AXES[vertical])
    except InputError as error:
        return {"warnings": str(error), "matched": 0}, None
    verdict = comparability(estimate, truth, max_dt, metric)
    offsets = estimate_offsets(estimate, truth, max_dt)
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
        known = offsets.as_dict()
        row |= {"time_offset_s": known["time_offset_s"], "time_offset_sd_s": known["time_offset_s_sd"]}
        row |= {"offsets": ", ".join(offsets.significant), "ate_sim3_without_offsets_m": offsets.ate_left}
    if verdict.reasons:
        row |= {"status": NOT_COMPARABLE, "message": "; ".join([*verdict.reasons, *verdict.doubts, *explained])}
    for name, delta, unit in DELTAS:
        row |= _relative(evaluate_trajectory(estimate, truth, max_dt, delta, unit=unit), name, metric)  # type: ignore[arg-type]
    return row, (report.se3 if metric else report.sim3).alignment


def _relative(report: TrajectoryReport, name: str, metric: bool) -> dict[str, Any]:
    pairs = report.relative if metric else report.relative_sim3
    return {
        f"rte_{name}_m": pairs.translation_statistics.mean,
        f"rre_{name}_deg": float(np.degrees(pairs.rotation_statistics.mean)),
    }


def _plain(value: Any) -> Any:
    """Of a type that JSON knows; None for NaN."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
