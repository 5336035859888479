"""`vggtgeo bench`: the paper's tables in simulation."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vggtgeo.cli.options import JsonOption

if TYPE_CHECKING:
    from vggtgeo.paper_bench.plan import Job
    from vggtgeo.paper_bench.store import BenchRun


def bench(
    what: Annotated[Literal["paper"], typer.Argument(help="What to measure: the tables of the paper.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder; finished runs in it are kept.")] = Path(
        "runs/paper"
    ),
    plan: Annotated[str, typer.Option(help="small (a minute), quick (half an hour) or full (a day).")] = "quick",
    scenes: Annotated[str | None, typer.Option(help="Some scenes of the plan, with commas.")] = None,
    variants: Annotated[str | None, typer.Option(help="Some variants of the plan, with commas.")] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Number of seeds, in place of the plan's.")] = None,
    first_seed: Annotated[int | None, typer.Option(min=0, help="First seed.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes, of up to 4 GB each.")] = 2,
    quiet: Annotated[bool, typer.Option("--quiet/--no-quiet", help="Print the tables only.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run the comparisons of the paper with simulated roles in rendered worlds, and print their tables."""
    from vggtgeo.paper_bench.runner import bench as run_bench  # brings JAX, which --help does without

    began = time.monotonic()

    def say(number: int, total: int, job: Job, result: BenchRun) -> None:
        if not (quiet or as_json):
            errors = result.errors
            typer.echo(
                f"{number}/{total} {job.name}: ATE {100 * errors.ate_m:.2f} cm, {errors.keyframes} keyframes, run of "
                f"{errors.seconds:.0f} s, {time.monotonic() - began:.0f} s in all (simulated)",
                err=True,
            )

    report = run_bench(
        output,
        plan,
        scenes=_list(scenes),
        variants=_list(variants),
        seeds=seeds,
        first_seed=first_seed,
        progress=say,
        workers=workers,
    )
    typer.echo(json.dumps(report.to_dict()) if as_json else report.markdown())
    if not (quiet or as_json):
        typer.echo(f"in {output}: tables.md runs.csv ablations.png", err=True)


def _list(text: str | None) -> list[str] | None:
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]
