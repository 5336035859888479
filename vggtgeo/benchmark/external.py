"""Trajectories of other systems, evaluated like the suite's own runs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from vggtgeo.benchmark.jobs import Job
from vggtgeo.benchmark.measure import trajectory_errors
from vggtgeo.benchmark.provenance import input_hash
from vggtgeo.benchmark.suite import ExternalTable, Suite
from vggtgeo.benchmark.table import Row
from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.image_files import is_there
from vggtgeo.datasets.pose_files import load_trajectory
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning


def external_rows(suite: Suite, jobs: Sequence[Job], runs: Path, base: Path) -> list[Row]:
    """Return a row for each existing file of `[[external]]`; `files` is relative to the folder `base`.

    The ground truth is that of a run on the same sequence and seed (in `runs`), or of the recording.
    """
    found: list[Row] = []
    for table in suite.external:
        places: dict[Path, Job] = {}
        for job in jobs:
            file = base / table.file(job.sequence, job.seed)
            if is_there(file):
                places.setdefault(file, job)
        found += [_row(suite, table, job, file, runs) for file, job in places.items()]
    return found


def warn_of_missing(suite: Suite, jobs: Sequence[Job], base: Path) -> None:
    """Warn of each `[[external]]` without any file, before the runs begin."""
    for table in suite.external:
        files = list(dict.fromkeys(base / table.file(job.sequence, job.seed) for job in jobs))
        if files and not any(map(is_there, files)):
            more = f", nor any other of {len(files)} files" if len(files) > 1 else ""
            text = f"external `{table.name}` has no trajectory: `{files[0]}` does not exist{more}"
            warnings.warn(text, InputWarning, stacklevel=2)


def _row(suite: Suite, table: ExternalTable, job: Job, file: Path, runs: Path) -> Row:
    row = {"suite": suite.name, "sequence": job.sequence, "setting": table.name, "seed": job.seed}
    row |= {"external": str(file), "input_hash": input_hash(file), "metric": table.metric}
    row |= {"protocol": job.spec["protocol"], "status": "ok", "simulated": bool(job.spec["simulate"])}
    try:
        truth = _truth(job, runs)
        if truth is None:
            return {**row, "status": "error", "message": "the sequence has no ground truth"}
        errors, _ = trajectory_errors(load_trajectory(file, truth), truth, table.metric, vertical=job.spec["vertical"])
    except InputError as error:
        return {**row, "status": "error", "message": str(error)}
    return {**row, **errors}


def _truth(job: Job, runs: Path) -> Trajectory | None:
    kept = sorted(runs.glob(f"{job.sequence}.*.{job.seed}/truth.txt"))
    if kept:
        return Trajectory.load_tum(kept[0])
    return open_sequence(job.spec["path"], job.spec["kind"]).ground_truth() if job.spec["path"] else None
