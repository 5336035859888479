"""`vggtgeo data`: list known datasets (`datasets/catalogue.toml`), and check a recording."""

from __future__ import annotations

import json
import tomllib
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
        typer.echo(json.dumps(entries))
        return
    for entry in entries:
        typer.echo(f"{entry['name']} (--kind {entry['kind'].partition(',')[0]})")
        suite = f"vggtgeo bench {entry['suite']}" if entry["suite"] else ""
        heads = {"url": "get", "size": "size", "licence": "licence", "layout": "layout", "note": "note"}
        for head, text in (*((head, entry[key]) for key, head in heads.items()), ("suite", suite)):
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


def catalogue() -> list[dict[str, str]]:
    """Return all entries: name; kind, of the reader; suite of `vggtgeo bench`, "" for none; url; size, rough; licence;
    layout; note.
    """
    text = (files("vggtgeo.datasets") / "catalogue.toml").read_text("utf-8")
    entries: list[dict[str, str]] = tomllib.loads(text)["entry"]
    return entries
