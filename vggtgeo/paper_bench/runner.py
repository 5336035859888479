"""All runs of a plan, then the tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from vggtgeo.errors import InputError
from vggtgeo.files import write_text
from vggtgeo.paper_bench import tables
from vggtgeo.paper_bench.figure import ablation_figure, write_figure
from vggtgeo.paper_bench.measure import measure
from vggtgeo.paper_bench.plan import PLANS, Job, Plan
from vggtgeo.paper_bench.stage import Stage
from vggtgeo.paper_bench.store import Result, Store
from vggtgeo.paper_bench.variants import VARIANTS

Progress = Callable[[int, int, Job, Result], None]
"""Called after each job with its number (from 1), the number of all, the job and its result."""


@dataclass(frozen=True)
class BenchReport:
    """The results of a plan; all simulated."""

    plan: Plan
    results: tuple[Result, ...]

    def markdown(self) -> str:
        """The tables: mean and standard deviation over seeds."""
        return tables.markdown(self.plan, self.results)

    def csv(self) -> str:
        """Every run, one a line; SI units and degrees."""
        return tables.as_csv(self.results)

    def figure(self) -> Figure:
        """The error of every run, by scene and variant."""
        return ablation_figure(self.results, f"Simulated ablations, plan `{self.plan.name}`")

    def write(self, folder: Path) -> None:
        """`tables.md`, `runs.csv` and `ablations.png`, each atomically."""
        write_text(folder / "tables.md", self.markdown())
        write_text(folder / "runs.csv", self.csv())
        write_figure(folder / "ablations.png", self.results, f"Simulated ablations, plan `{self.plan.name}`")


def bench(
    output: str | os.PathLike[str],
    plan: str = "quick",
    *,
    scenes: Iterable[str] | None = None,
    variants: Iterable[str] | None = None,
    seeds: int | None = None,
    first_seed: int | None = None,
    progress: Progress | None = None,
) -> BenchReport:
    """Run the paper's comparisons in simulation and write their tables into the folder `output`.

    Each finished run is a file in `output`/runs; a second call does only what is missing, and what other settings
    made. One walk is rendered at a time and serves all variants of its seed.

    plan: "small" (a minute), "quick" or "full". scenes, variants: the part of the plan to run. seeds: how many, in
    place of the plan's own; first_seed: the first of them. Raises InputError for names that are not there.
    """
    if plan not in PLANS:
        raise InputError(f"`plan` is {plan!r}; it must be one of {', '.join(PLANS)}")
    chosen = PLANS[plan].limited(scenes, variants, seeds, first_seed)
    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"`output` is {folder}, which is a file; give a folder")
    report = BenchReport(chosen, tuple(run_jobs(chosen.jobs(), Store(folder), progress)))
    report.write(folder)
    return report


def run_jobs(jobs: list[Job], store: Store, progress: Progress | None = None) -> list[Result]:
    """The results of `jobs` in their order, from the store or by running them."""
    results: list[Result] = []
    stage: Stage | None = None
    for number, job in enumerate(jobs, 1):
        result = store.load(job)
        if result is None:
            if stage is None or (stage.course, stage.seed) != (job.course, job.seed):
                stage = None  # before the next is rendered: two would need twice the memory
                stage = Stage.set(job.course, job.seed)
            result = store.save(job, measure(stage, VARIANTS[job.variant]))
        results.append(result)
        if progress is not None:
            progress(number, len(jobs), job, result)
    return results
