"""`vggtgeo.bench`: run a suite and write its tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.benchmark.cluster import Cluster, run_jobs_on_cluster
from vggtgeo.benchmark.figures import ablation_figure
from vggtgeo.benchmark.inputs import data_folders
from vggtgeo.benchmark.jobs import Job, Store, jobs_of
from vggtgeo.benchmark.measure import trajectory_errors
from vggtgeo.benchmark.processes import Limits, run_jobs
from vggtgeo.benchmark.provenance import input_hash, source_digest
from vggtgeo.benchmark.report import markdown, write_page
from vggtgeo.benchmark.rows import LESS_BASELINE, Row, as_csv, run_name, write_parquet
from vggtgeo.benchmark.suite import ExternalTable, Suite, load_suite, restrict
from vggtgeo.benchmark.tables import COMPARED, finished, is_covered
from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.image_files import path_exists
from vggtgeo.datasets.pose_files import load_trajectory
from vggtgeo.evaluation import evaluate_trajectory, followed
from vggtgeo.figures.plot import plot
from vggtgeo.figures.plots import NotebookFigure
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import path_of
from vggtgeo.io.errors import InputError, warn
from vggtgeo.io.files import locked_folder, write_text

OUTPUTS = ("report.html", "tables.md", "runs.csv", "runs.parquet")
"""Files of a suite in its folder; the last one only with PyArrow."""
_LOCK = ".bench.lock"
Progress = Callable[[int, int, Row], None]
"""Called after each run with the number of finished runs, the number of all runs, and the row."""


@dataclass(frozen=True)
class BenchReport:
    """The result of `vggtgeo.bench`; SI units, angles in degrees.

    Fields:
        suite: the suite.
        rows: one per run, in the order of the suite, then of other systems; `status` says how the run ended.
        folder: of the runs.

    """

    suite: Suite
    rows: tuple[Row, ...]
    folder: Path

    def markdown(self) -> str:
        """Return the tables: means and standard deviations, differences to the baseline, failures, provenance."""
        return markdown(self.suite, self.rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the name of the suite and all rows as plain values."""
        return {"suite": self.suite.name, "rows": [dict(row) for row in self.rows]}

    def write(self, folder: Path) -> None:
        """Write the files of `OUTPUTS`."""
        write_text(folder / "tables.md", self.markdown())
        write_text(folder / "runs.csv", as_csv(self.rows))
        write_page(folder / "report.html", self.suite, self.rows, self.folder)
        with suppress(InputError):
            write_parquet(folder / "runs.parquet", self.rows)

    def __repr__(self) -> str:
        good = sum(row["status"] == "ok" for row in self.rows)
        return f"BenchReport({self.suite.name}: {good} of {len(self.rows)} runs with a result, in {self.folder})"


@plot.register(BenchReport)
def _plot(value: BenchReport) -> NotebookFigure:
    return ablation_figure(value.suite, value.rows)


def bench(
    suite: str | os.PathLike[str] | Suite,
    output: str | os.PathLike[str],
    *,
    data: Iterable[str | os.PathLike[str]] | None = None,
    sequences: Iterable[str] | None = None,
    settings: Iterable[str] | None = None,
    seeds: int | None = None,
    first_seed: int | None = None,
    frames: int | None = None,
    workers: int = 1,
    timeout_minutes: float | None = None,
    memory_gb: float | None = None,
    retry: bool = False,
    recordings: bool | None = None,
    progress: Progress | None = None,
    cluster: Cluster | None = None,
) -> BenchReport:
    """Run a suite (sequences x settings x seeds) and write its tables and its report into the folder `output`.

    Each run is a process with limits of time and memory: a crash or a timeout is a row in the tables. Finished runs are
    kept in `output`/runs. A second call runs only what is missing, or whose settings, inputs or code have changed.

    Args:
        suite: a TOML file, or the name of a shipped suite: quick, simulated, paper, clips, tum, 7scenes, ...
        output: folder.
        data: folders of recordings; by default those of `$VGGTGEO_DATA`, else `data`.
        sequences: names of the sequences to run; by default all.
        settings: names of the settings to run; by default all.
        seeds: number of seeds; overrides the suite's.
        first_seed: first seed; overrides the suite's.
        frames: maximum number of frames of each sequence.
        workers: number of parallel processes; each gets an equal share of the processors.
        timeout_minutes: limit of one run; overrides the suite's.
        memory_gb: limit of one run; overrides the suite's.
        retry: repeat runs that ended without a result.
        recordings: whether each run writes `run.rrd` for the Rerun viewer; overrides the suite's.
        progress: see `Progress`.
        cluster: Ray cluster to run on, instead of local processes.

    Raises:
        InputError: an invalid suite, an unknown name, or a missing folder.

    Example:
        >>> import vggtgeo as vg
        >>> vg.bench("quick", "runs/quick", sequences=["ofice"])  # with "office": every setting on that sequence
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `sequences` must be of office, corridor, redkitchen, icl-office, got ['ofice']

    """
    chosen = suite if isinstance(suite, Suite) else load_suite(path_of("suite", suite))
    names, variants = (None if given is None else tuple(given) for given in (sequences, settings))
    chosen = restrict(chosen, names, variants, seeds, first_seed, frames)
    overrides: dict[str, Any] = {"recordings": recordings, "timeout_minutes": timeout_minutes, "memory_gb": memory_gb}
    chosen = replace(chosen, **{name: value for name, value in overrides.items() if value is not None})
    folder = path_of("output", output)
    _check_output(folder)
    if workers < 1:
        raise InputError(f"`workers` must be at least 1, got {workers}")
    jobs = jobs_of(chosen, data_folders(data))
    base = Path(suite).parent if not isinstance(suite, Suite) else Path()
    with locked_folder(folder, _LOCK, "batch"):  # two batches would delete each other's runs
        store = Store(folder, chosen.name, source_digest())
        limits = Limits(60 * chosen.timeout_minutes, chosen.memory_gb)
        rows = all_rows(jobs, store, limits, workers, retry, progress, cluster)
        rows += external_rows(chosen, jobs, folder / "runs", base)
        rows = subtract_baseline(chosen, rows, folder / "runs")
        report = BenchReport(chosen, tuple(rows), folder)
        report.write(folder)
    return report


def _check_output(folder: Path) -> None:
    """Raise InputError if the batch would replace files of something else, for example of a single run."""
    there = [name for name in OUTPUTS if (folder / name).exists()]
    if there and not (folder / "runs").is_dir() and not {"tables.md", "runs.csv"} <= set(there):
        raise InputError(
            f"`{folder}` has no batch, but a file `{there[0]}` that the batch would replace; give another folder with "
            "`-o`"
        )


def all_rows(
    jobs: Sequence[Job],
    store: Store,
    limits: Limits,
    workers: int = 1,
    retry: bool = False,
    progress: Progress | None = None,
    cluster: Cluster | None = None,
    **options: Any,
) -> list[Row]:
    """Return the rows of `jobs` in their order, from the store or by running them."""
    rows: dict[str, Row] = {}

    def note(job: Job, row: Row) -> None:
        rows[job.name] = row
        if progress is not None:
            progress(len(rows), len(jobs), row)

    missing = []
    for job in jobs:
        row = store.load(job, retry) if job.present else store.absent(job)
        if row is None:
            missing.append(job)
        else:
            note(job, row)
    if cluster is not None:
        run_jobs_on_cluster(missing, store, limits, cluster, note, **options)
    else:
        run_jobs(missing, store, limits, min(workers, max(len(missing), 1)), note, **options)
    return [rows[job.name] for job in jobs]


def external_rows(suite: Suite, jobs: Sequence[Job], runs: Path, base: Path) -> list[Row]:
    """Return a row for each existing file of `[[external]]`; its `files` are relative to the folder `base`.

    The ground truth is that of a run on the same sequence and seed (in `runs`), or of the recording. Warns of a system
    without files.
    """
    rows = []
    for table in suite.external:
        files: dict[Path, Job] = {}
        for job in jobs:
            files.setdefault(base / table.file(job.sequence, job.seed), job)
        there = {file: job for file, job in files.items() if path_exists(file)}
        if files and not there:
            warn(f"external `{table.name}` has no trajectory: `{next(iter(files))}` does not exist")
        rows += [_external_row(suite, table, job, file, runs) for file, job in there.items()]
    return rows


def _external_row(suite: Suite, table: ExternalTable, job: Job, file: Path, runs: Path) -> Row:
    row = {"suite": suite.name, "sequence": job.sequence, "setting": table.name, "seed": job.seed}
    row |= {"external": str(file), "input_hash": input_hash(file), "metric": table.metric}
    row |= {"protocol": job.spec["protocol"], "status": "ok", "simulated": bool(job.spec["simulate"])}
    try:
        truth = _truth(job, runs)
        errors, _ = trajectory_errors(load_trajectory(file, truth), truth, table.metric, vertical=job.spec["vertical"])
    except InputError as error:
        return {**row, "status": "error", "message": str(error)}
    return {**row, **errors}


def _truth(job: Job, runs: Path) -> Trajectory:
    kept = sorted(runs.glob(f"{job.sequence}.*.{job.seed}/truth.txt"))
    if kept:
        return Trajectory.load_tum(kept[0])
    truth = open_sequence(job.spec["path"], job.spec["kind"]).ground_truth() if job.spec["path"] else None
    if truth is None:
        raise InputError("the sequence has no ground truth")
    return truth


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
    """Return the differences of the pose errors; empty if a trajectory is missing."""
    truth = runs / run_name(base) / "truth.txt"
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


def _estimate(row: Row, runs: Path) -> Path:
    return Path(row["external"]) if "external" in row else runs / run_name(row) / "estimate.txt"
