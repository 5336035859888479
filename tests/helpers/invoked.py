"""A command, called in this process."""

from __future__ import annotations

from typer.testing import CliRunner

from vggtgeo.cli.main import make_app


def invoke(*arguments: str):
    return CliRunner().invoke(make_app(), list(arguments))
