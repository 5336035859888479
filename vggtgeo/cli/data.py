"""`vggtgeo data`: list known datasets (`datasets/catalogue.toml`), and check a recording."""

from __future__ import annotations

import json
import tomllib
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from vggtgeo.cli.options import EXIT_INPUT, JsonOption

data = typer.Typer(
    help="Where to get recordings, and what is wrong with one.", no_args_is_help=True, add_completion=False
)


@data.command("list")
def list_command(as_json: JsonOption = False) -> None:
    """List what the readers know: where to get it, its size, licence and layout."""
    entries = catalogue()
    if as_json:
        typer.echo(json.dumps([asdict(entry) for entry in entries]))
        return
    for entry in entries:
        typer.echo(f"{entry.name} (--kind {entry.kind.partition(',')[0]})")
        suite = f"vggtgeo bench {entry.suite}" if entry.suite else ""
        lines = ("get", entry.url), ("size", entry.size), ("licence", entry.licence), ("layout", entry.layout)
        for head, text in (*lines, ("note", entry.note), ("suite", suite)):
            if text:
                typer.echo(f"  {head:8s}{text}")


@data.command("check")
def check_command(
    path: Annotated[str, typer.Argument(metavar="PATH", help="Folder, video, bag or stream.")],
    kind: Annotated[str | None, typer.Option(help="Reader; found by looking.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Say what is wrong with the recording at PATH, in sentences; exit code 2 where something is."""
    from vggtgeo.datasets.check import inspect

    found = inspect(path if "://" in path or path.startswith("webcam") else Path(path), kind)
    if as_json:
        typer.echo(json.dumps({"facts": found.facts, "problems": found.problems}))
    else:
        for fact in found.facts:
            typer.echo(fact)
        for problem in found.problems:
            typer.echo(f"- {problem}")
        typer.echo(f"{len(found.problems)} problems" if found.problems else "no problem found")
    if found.problems:
        raise typer.Exit(EXIT_INPUT)


@dataclass(frozen=True)
class Entry:
    """name; kind, of the reader; suite of `vggtgeo bench`, "" for none; url; size, rough; licence; layout; note."""

    name: str
    kind: str
    suite: str
    url: str
    size: str
    licence: str
    layout: str
    note: str


def catalogue() -> tuple[Entry, ...]:
    """Return all entries."""
    text = (files("vggtgeo.datasets") / "catalogue.toml").read_text("utf-8")
    return tuple(Entry(**entry) for entry in tomllib.loads(text)["entry"])
