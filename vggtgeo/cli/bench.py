"""`vggtgeo bench`: run a benchmark suite."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vggtgeo.cli.options import JsonOption

if TYPE_CHECKING:
    from vggtgeo.benchmark.rows import Row
    from vggtgeo.benchmark.runner import BenchReport


def bench(
    suite: Annotated[
        str, typer.Argument(metavar="SUITE", help="TOML file, or name of a suite in the package; `list` prints them.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Folder; finished runs in it are kept.", show_default="runs/SUITE"),
    ] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of recordings; may be given several times.", show_default="$VGGTGEO_DATA, data"),
    ] = None,
    sequences: Annotated[str | None, typer.Option(help="Sequences to run, separated by commas.")] = None,
    settings: Annotated[str | None, typer.Option(help="Settings to run, separated by commas.")] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Number of seeds, instead of the suite's.")] = None,
    first_seed: Annotated[int | None, typer.Option(min=0, help="First seed.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Maximum frames of each sequence.")] = None,
    workers: Annotated[
        int, typer.Option(min=1, help="Parallel processes; each gets an equal share of the processors.")
    ] = 1,
    timeout_minutes: Annotated[float | None, typer.Option(help="Limit of a run, instead of the suite's.")] = None,
    memory_gb: Annotated[float | None, typer.Option(help="Limit of a run, instead of the suite's.")] = None,
    retry: Annotated[bool, typer.Option(help="Repeat runs that ended without a result.")] = False,
    recordings: Annotated[
        bool | None, typer.Option(help="Write run.rrd of each run, for Rerun.", show_default="the suite's")
    ] = None,
    engine: Annotated[
        Literal["processes", "ray"], typer.Option(help="Processes of this machine, or a Ray cluster.")
    ] = "processes",
    address: Annotated[str, typer.Option(help="Address of the Ray cluster; local starts one.")] = "auto",
    cpus: Annotated[float, typer.Option(help="Processors of each run on the cluster.")] = 1.0,
    gpus: Annotated[float, typer.Option(help="GPUs of each run on the cluster.")] = 0.0,
    quiet: Annotated[bool, typer.Option(help="Print the tables only.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run a suite of sequences, settings and seeds, and write its tables and its report.

    Exit code 1: no run has a result.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from vggtgeo.benchmark.cluster import Cluster
    from vggtgeo.benchmark.runner import bench as run_suite  # imports JAX, which would make --help slow
    from vggtgeo.benchmark.suite import load_suite, shipped

    if suite == "list":
        for name, title in shipped().items():
            typer.echo(f"{name:14s} {title}")
        return
    load_suite(Path(suite))  # to report its errors before the progress bar starts
    folder = output or Path("runs") / Path(suite).stem
    console = Console(stderr=True, quiet=quiet or as_json)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    # Without a terminal each run prints a line instead.
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("runs", total=None)

        def advance(done: int, total: int, row: Row) -> None:
            bar.update(task, completed=done, total=total)
            console.print(_line(row), markup=False, highlight=False, soft_wrap=True)

        report = run_suite(
            suite,
            folder,
            data=data,
            sequences=_list(sequences),
            settings=_list(settings),
            seeds=seeds,
            first_seed=first_seed,
            frames=frames,
            workers=workers,
            timeout_minutes=timeout_minutes,
            memory_gb=memory_gb,
            retry=retry,
            recordings=recordings,
            progress=advance,
            cluster=Cluster(address, cpus, gpus) if engine == "ray" else None,
        )
    _print(report, folder, quiet=quiet, as_json=as_json)
    if not any(row["status"] == "ok" for row in report.rows):
        raise typer.Exit(1)


def _print(report: BenchReport, folder: Path, *, quiet: bool, as_json: bool) -> None:
    """Print the tables of a suite, or its rows as JSON, and which files it wrote."""
    from vggtgeo.benchmark.runner import OUTPUTS

    typer.echo(json.dumps(report.to_dict()) if as_json else report.markdown())
    if not (quiet or as_json):
        typer.echo(f"in {folder}: {' '.join(name for name in OUTPUTS if (folder / name).is_file())}", err=True)


def _line(row: Row) -> str:
    name = f"{row['sequence']}, {row['setting']}, seed {row['seed']}"
    if row["status"] != "ok":
        return f"{name}: {row['status']}; {row.get('message', '')}"
    error = row.get("ate_se3_m") if row.get("metric") else row.get("ate_sim3_m")
    text = "" if error is None else f" ATE {100 * error:.2f} cm after {'SE(3)' if row.get('metric') else 'Sim(3)'},"
    simulated = " (simulated)" if row.get("simulated") else ""
    doubts = f"; {row['warnings']}" if row.get("warnings") else ""
    return f"{name}:{text} {row['tracked']}/{row['frames']} frames, {row['verdict']}{simulated}{doubts}"


def _list(text: str | None) -> list[str] | None:
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]
