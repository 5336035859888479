"""Differences to the baseline over the time that both runs cover.

Without this, a run that loses track in the difficult parts would have a smaller error than one that does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.benchmark.cells import COMPARED, finished, is_covered
from vggtgeo.benchmark.statistics import LESS_BASELINE
from vggtgeo.benchmark.suite import Suite
from vggtgeo.benchmark.table import Row
from vggtgeo.datasets.pose_files import load_trajectory
from vggtgeo.evaluation import evaluate_trajectory, followed
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError


def subtract_baseline(suite: Suite, rows: Sequence[Row], runs: Path) -> list[Row]:
    """Return the rows with their differences to the baseline of the same sequence and seed. runs: the runs' folder.

    Pose errors are over the common time. Errors of depth and map have no difference if one of the two runs does not
    cover the sequence.
    """
    other = {(row["sequence"], row["seed"]): row for row in finished(rows) if row["setting"] == suite.base}
    found = []
    for row in rows:
        base = other.get((row["sequence"], row["seed"]))
        if base is None or base is row or row["status"] != "ok":
            found.append(row)
            continue
        whole: dict[str, Any] = {} if is_covered([row, base]) else {column.name: None for column in COMPARED}
        differences = whole | _pose_differences(row, base, runs)
        found.append({**row, **{f"{name}{LESS_BASELINE}": value for name, value in differences.items()}})
    return found


def _pose_differences(row: Row, base: Row, runs: Path) -> dict[str, Any]:
    """Differences of the pose errors; empty if a trajectory is missing."""
    truth = _place(base, runs) / "truth.txt"
    files = _estimate(row, runs), _estimate(base, runs)
    if not all(file.is_file() for file in (truth, *files)):
        return {}
    true = Trajectory.load_tum(truth)
    ours, theirs = (load_trajectory(file, true) for file in files)
    try:
        first = _errors(ours.select(followed(ours.timestamps, theirs, true)), true)
        second = _errors(theirs.select(followed(theirs.timestamps, ours, true)), true)
    except InputError:  # fewer than three poses in common
        return dict.fromkeys(("ate_se3_m", "ate_sim3_m", "rre_1s_deg"))
    return {name: first[name] - second[name] for name in first}


def _errors(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    report = evaluate_trajectory(estimate, truth, delta=1.0, unit="seconds")
    return {
        "ate_se3_m": report.se3.statistics.rmse,
        "ate_sim3_m": report.sim3.statistics.rmse,
        "rre_1s_deg": float(np.degrees(report.relative.rotation_statistics.mean)),
    }


def _place(row: Row, runs: Path) -> Path:
    return runs / f"{row['sequence']}.{row['setting']}.{row['seed']}"


def _estimate(row: Row, runs: Path) -> Path:
    return Path(row["external"]) if "external" in row else _place(row, runs) / "estimate.txt"
