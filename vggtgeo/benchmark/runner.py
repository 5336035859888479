"""A suite from its file to its tables: `vggtgeo.bench`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vggtgeo.benchmark import markdown
from vggtgeo.benchmark.cluster import Cluster, run_jobs_on_cluster
from vggtgeo.benchmark.common_time import less_baseline
from vggtgeo.benchmark.external import external_rows, tell_missing
from vggtgeo.benchmark.figures import ablation_figure
from vggtgeo.benchmark.inputs import data_folders
from vggtgeo.benchmark.jobs import Job, jobs_of
from vggtgeo.benchmark.page import write_page
from vggtgeo.benchmark.processes import Limits
from vggtgeo.benchmark.provenance import source_digest
from vggtgeo.benchmark.scheduling import run_jobs
from vggtgeo.benchmark.store import Store
from vggtgeo.benchmark.suite import Suite, limited, load_suite
from vggtgeo.benchmark.table import Row, as_csv, write_parquet
from vggtgeo.figures.plot import plot
from vggtgeo.figures.plots import NotebookFigure
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import whole_path, write_text
from vggtgeo.io.given import path_of
from vggtgeo.io.locks import locked_folder

OUTPUTS = ("report.html", "tables.md", "runs.csv", "runs.parquet")
"""What a suite leaves in its folder; the last where PyArrow is there."""
_LOCK = ".bench.lock"
Progress = Callable[[int, int, Row], None]
"""Called after each run with the number of those that are done, the number of all, and the row."""


@dataclass(frozen=True)
class BenchReport:
    """The rows of a suite, as `vggtgeo.bench` returns them; SI units, angles in degrees.

    Fields:
        suite: what was to be run.
        rows: a run each, in the order of the suite, then those of other systems; `status` says how it ended.
        folder: of the runs.

    """

    suite: Suite
    rows: tuple[Row, ...]
    folder: Path

    def markdown(self) -> str:
        """The tables: means and standard deviations, differences from the baseline, what went wrong, provenance."""
        return markdown.page(self.suite, self.rows)

    def csv(self) -> str:
        """Every run, one a line."""
        return as_csv(self.rows)

    def to_dict(self) -> dict[str, Any]:
        """The name of the suite and every row, as plain values."""
        return {"suite": self.suite.name, "rows": [dict(row) for row in self.rows]}

    def write(self, folder: Path) -> None:
        """The files of `OUTPUTS`."""
        write_text(folder / "tables.md", self.markdown())
        write_text(folder / "runs.csv", self.csv())
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
    """Run a suite (sequences x settings x seeds) and write its tables and its page into the folder `output`.

    Each run is a process of its own with limits of time and memory: a crash or a hang is a row, not the end. Each
    finished run lies in `output`/runs; a second call does only what is missing, and what other settings, inputs or
    another version of the code made.

    Args:
        suite: a TOML file, or the name of a suite that comes along: quick, simulated, paper, clips, tum, 7scenes, ...
        output: folder.
        data: folders that hold the recordings; by default those of `$VGGTGEO_DATA`, else `data`.
        sequences: those of the suite to run.
        settings: those of the suite to run.
        seeds: how many, in place of the suite's own.
        first_seed: the first of them.
        frames: of each sequence at most.
        workers: processes at once; the processors are shared out among them.
        timeout_minutes: limit of one run, in place of the suite's.
        memory_gb: limit of one run, in place of the suite's.
        retry: run again what ended without a result.
        recordings: whether each run leaves `run.rrd` for the Rerun viewer, in place of the suite's.
        progress: see `Progress`.
        cluster: a Ray cluster to run on, in place of processes here.

    Raises:
        InputError: a suite, a name in it or a folder that is not there.

    Example:
        >>> import vggtgeo as vg
        >>> vg.bench("quick", "runs/quick", sequences=["ofice"])  # with "office": every setting on that sequence
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `sequences` holds ['ofice']; choose among office, corridor, redkitchen, icl-office

    """
    chosen = suite if isinstance(suite, Suite) else load_suite(path_of("suite", suite))
    chosen = limited(chosen, _names("sequences", sequences), _names("settings", settings), seeds, first_seed, frames)
    chosen = replace(
        chosen,
        recordings=chosen.recordings if recordings is None else recordings,
        timeout_minutes=chosen.timeout_minutes if timeout_minutes is None else timeout_minutes,
        memory_gb=chosen.memory_gb if memory_gb is None else memory_gb,
    )
    folder = path_of("output", output)
    _check_output(folder)
    if workers < 1:
        raise InputError(f"`workers` is {workers}; it must be at least 1")
    jobs = jobs_of(chosen, data_folders(data))
    base = Path(suite).parent if not isinstance(suite, Suite) else Path()
    tell_missing(chosen, jobs, base)
    with locked_folder(folder, _LOCK, "batch"):  # two would take each other's runs away
        store = Store(folder, chosen.name, source_digest())
        limits = Limits(60 * chosen.timeout_minutes, chosen.memory_gb)
        rows = all_rows(jobs, store, limits, workers, retry, progress, cluster)
        rows += external_rows(chosen, jobs, folder / "runs", base)
        rows = less_baseline(chosen, rows, folder / "runs")
        report = BenchReport(chosen, tuple(rows), folder)
        report.write(folder)
    return report


def _check_output(folder: Path) -> None:
    """InputError where a batch would replace files that are not of one: those of a single run, say."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"`output` is `{folder}`, which is a file; give a folder")
    if whole_path(folder) == Path(whole_path(folder).anchor):
        raise InputError(f"`output` is `{folder}`, the root of the file system; give a folder")
    there = [name for name in OUTPUTS if (folder / name).exists()]
    if there and not (folder / "runs").is_dir() and not {"tables.md", "runs.csv"} <= set(there):
        raise InputError(
            f"`{folder}` holds `{there[0]}`, which a batch replaces, and nothing else of a batch; give another folder "
            "with `-o`"
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
    """The rows of `jobs` in their order, from the store or by running them, in processes here or on a cluster."""
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


def _names(what: str, names: Iterable[str] | None) -> tuple[str, ...] | None:
    if isinstance(names, str):  # a text is an iterable of its letters
        raise InputError(f"`{what}` is {names!r}; expected a list of names, as [{names!r}]")
    return None if names is None else tuple(names)
