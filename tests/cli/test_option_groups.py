"""Option groups of the command line: dataclasses whose fields are options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from vggtgeo.cli.options import with_option_groups


@dataclass(frozen=True)
class Shape:
    width: Annotated[int, typer.Option(min=1, help="Pixels.")] = 4
    tall: Annotated[bool, typer.Option("--tall/--flat")] = False


@dataclass(frozen=True)
class Times:
    rate: Annotated[float, typer.Option("-r", "--rate")] = 30.0


def command(name: str, output: Annotated[str, typer.Option("-o")] = "out", *, shape: Shape, times: Times) -> None:
    typer.echo(repr((name, output, shape, times)))


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], ("a", "out", Shape(), Times())),
        (["--width", "7", "-r", "2"], ("a", "out", Shape(7), Times(2.0))),
        (["--tall", "-o", "b"], ("a", "b", Shape(tall=True), Times())),
    ],
)
def test_fields_are_options(flags: list[str], expected: tuple[object, ...]) -> None:
    """Options reach the fields of their group, and fields without a flag have their default; oracle: the values."""
    app = typer.Typer()
    app.command()(with_option_groups(command))
    done = CliRunner().invoke(app, ["a", *flags])
    assert done.exit_code == 0, done.output
    assert done.stdout.strip() == repr(expected)
