"""All runs of a plan, then the tables."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from vggtgeo.figures.plot import plot
from vggtgeo.figures.plots import NotebookFigure
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import write_text
from vggtgeo.paper_bench import tables
from vggtgeo.paper_bench.courses import Course
from vggtgeo.paper_bench.figure import ablation_figure, write_figure
from vggtgeo.paper_bench.measure import measure
from vggtgeo.paper_bench.plan import PLANS, Job, Plan
from vggtgeo.paper_bench.stage import Stage
from vggtgeo.paper_bench.store import BenchRun, Store
from vggtgeo.paper_bench.variants import VARIANTS

Progress = Callable[[int, int, Job, BenchRun], None]
"""Called after each job with its number (from 1), the number of all, the job and its result."""


@dataclass(frozen=True)
class BenchReport:
    """The results of a plan, as `vggtgeo.bench` returns them; all simulated. Lengths in metres, angles in degrees.

    Fields:
        plan: what was to be run.
        results: a run each, in the order of the plan: scene, variant, seed and `errors`.

    """

    plan: Plan
    results: tuple[BenchRun, ...]

    def markdown(self) -> str:
        """The tables: mean and standard deviation over seeds."""
        return tables.markdown(self.plan, self.results)

    def csv(self) -> str:
        """Every run, one a line; SI units and degrees."""
        return tables.as_csv(self.results)

    def to_dict(self) -> dict[str, Any]:
        """Plan and every run as plain values, SI units and degrees."""
        return {"plan": self.plan.name, "simulated": True, "runs": [asdict(result) for result in self.results]}

    def write(self, folder: Path) -> None:
        """`tables.md`, `runs.csv` and `ablations.png`, each atomically."""
        write_text(folder / "tables.md", self.markdown())
        write_text(folder / "runs.csv", self.csv())
        write_figure(folder / "ablations.png", self.results, f"Simulated ablations, plan `{self.plan.name}`")


@plot.register(BenchReport)
def _plot(value: BenchReport) -> NotebookFigure:
    return ablation_figure(value.results, f"Simulated ablations, plan `{value.plan.name}`")


def bench(
    output: str | os.PathLike[str],
    plan: str = "quick",
    *,
    scenes: Iterable[str] | None = None,
    variants: Iterable[str] | None = None,
    seeds: int | None = None,
    first_seed: int | None = None,
    progress: Progress | None = None,
    workers: int = 1,
) -> BenchReport:
    """Run the paper's comparisons in simulation and write their tables into the folder `output`.

    Each finished run is a file in `output`/runs; a second call does only what is missing, and what other settings
    made. One walk is rendered at a time and serves all variants of its seed.

    plan: "small" (a minute), "quick" or "full". scenes, variants: the part of the plan to run. seeds: how many, in
    place of the plan's own; first_seed: the first of them. workers: processes, each of which takes up to 4 GB with the
    plan "quick". Raises InputError for names that are not there.

    Example:
        >>> import vggtgeo as vg
        >>> vg.bench("runs/office", "quick", scenes=["ofice"])  # with "office": every run of that scene
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `scenes` holds ['ofice']; choose among office, hall, corridor

    """
    if plan not in PLANS:
        raise InputError(f"`plan` is {plan!r}; it must be one of {', '.join(PLANS)}")
    chosen = PLANS[plan].limited(scenes, variants, seeds, first_seed)
    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"`output` is {folder}, which is a file; give a folder")
    if workers < 1:
        raise InputError(f"`workers` is {workers}; it must be at least 1")
    report = BenchReport(chosen, tuple(run_jobs(chosen.jobs(), Store(folder), progress, workers)))
    report.write(folder)
    return report


def run_jobs(jobs: list[Job], store: Store, progress: Progress | None = None, workers: int = 1) -> list[BenchRun]:
    """The results of `jobs` in their order, from the store or by running them, one walk to a process at a time."""
    found = {job: result for job in jobs if (result := store.load(job)) is not None}
    say = _counted(jobs, progress)
    for job, result in found.items():
        say(job, result)
    walks = _by_walk([job for job in jobs if job not in found])
    if workers == 1 or len(walks) < 2:
        for walk in walks:
            for job, result in _run_walk(walk, store):
                found[job] = result
                say(job, result)
    else:
        for job, result in _run_in_processes(walks, store, workers):
            found[job] = result
            say(job, result)
    return [found[job] for job in jobs]


def _by_walk(jobs: list[Job]) -> list[list[Job]]:
    walks: dict[tuple[Course, int], list[Job]] = {}
    for job in jobs:
        walks.setdefault((job.course, job.seed), []).append(job)
    return list(walks.values())


def _run_walk(jobs: list[Job], store: Store) -> Iterator[tuple[Job, BenchRun]]:
    """Jobs of one course and seed: the walk is rendered once."""
    stage = Stage.set(jobs[0].course, jobs[0].seed)
    for job in jobs:
        yield job, store.save(job, measure(stage, VARIANTS[job.variant]))


def _finish_walk(jobs: list[Job], store: Store) -> None:
    for _ in _run_walk(jobs, store):
        pass


def _run_in_processes(walks: list[list[Job]], store: Store, workers: int) -> Iterator[tuple[Job, BenchRun]]:
    """Results as they appear in the store. New processes, not forks: JAX has threads."""
    waiting = [job for walk in walks for job in walk]
    with ProcessPoolExecutor(min(workers, len(walks)), get_context("spawn")) as pool:
        try:
            running = {pool.submit(_finish_walk, walk, store) for walk in walks}
            while waiting:
                done, running = wait(running, timeout=1.0, return_when=FIRST_EXCEPTION)
                for future in done:
                    future.result()
                arrived = {job: result for job in waiting if (result := store.load(job)) is not None}
                waiting = [job for job in waiting if job not in arrived]
                yield from arrived.items()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _counted(jobs: list[Job], progress: Progress | None) -> Callable[[Job, BenchRun], None]:
    numbers = itertools.count(1)

    def say(job: Job, result: BenchRun) -> None:
        if progress is not None:
            progress(next(numbers), len(jobs), job, result)

    return say
