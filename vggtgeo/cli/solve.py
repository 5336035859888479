"""`vggtgeo solve`: a bundle-adjustment problem from a file."""

import enum
import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from vggtgeo.cli.options import EXIT_FAILED, JsonOption, QuietOption


class Precision(enum.StrEnum):
    """Float type of a solve."""

    float64 = "float64"
    float32 = "float32"


def solve(
    problem: Annotated[
        Path, typer.Argument(metavar="PROBLEM", help="Problem (.npz), see docs/reference/problem-file.md.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Solution (.npz): T, k, d.")],
    max_steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="Most iterations (tried steps).")] = 50,
    dtype: Annotated[Precision, typer.Option(help="Precision of the solve.")] = Precision.float64,
    repeat: Annotated[int, typer.Option(min=1, max=100_000, help="Runs to take the median time of.")] = 1,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Solve the bundle-adjustment problem in PROBLEM."""
    from vggtgeo.cli.timed_solve import check_output, solve_file

    check_output(problem, output)
    report = solve_file(problem, output, max_steps, dtype.value, repeat)
    if as_json or not quiet:
        typer.echo(json.dumps(asdict(report), allow_nan=False) if as_json else report.sentence)
    if report.result == "nonfinite_step":
        raise typer.Exit(EXIT_FAILED)
