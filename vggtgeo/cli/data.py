"""`vggtgeo data`: list known datasets (`catalogue.toml`), check a recording; `vggtgeo simulate`: render a recording."""

from __future__ import annotations

import json
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from vggtgeo.cli.options import EXIT_INPUT, JsonOption, QuietOption, parse_size
from vggtgeo.io.errors import one_line

data = typer.Typer(
    help="List datasets that can be read, and check a recording.", no_args_is_help=True, add_completion=False
)


@data.command("list")
def list_command(as_json: JsonOption = False) -> None:
    """List the datasets that can be read: source, size, licence and layout."""
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
    kind: Annotated[str | None, typer.Option(help="Reader; by default detected.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Check the recording at PATH and print its problems; exit code 2 if there are any."""
    from vggtgeo.datasets.check import inspect

    found = inspect(path if "://" in path or path.startswith("webcam") else Path(path), kind)
    if as_json:
        typer.echo(json.dumps({"facts": found.facts, "problems": found.problems}))
    else:
        for fact in found.facts:
            typer.echo(fact)
        for problem in found.problems:
            typer.echo(f"- {one_line(problem)}")
        typer.echo(f"{len(found.problems)} problems" if found.problems else "no problem found")
    if found.problems:
        raise typer.Exit(EXIT_INPUT)


def catalogue() -> list[dict[str, str]]:
    """Return all entries: name; kind, the reader; suite of `vggtgeo bench`, or ""; url; size; licence; layout; note."""
    text = (files("vggtgeo.datasets") / "catalogue.toml").read_text("utf-8")
    entries: list[dict[str, str]] = tomllib.loads(text)["entry"]
    return entries


def simulate(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="room, office, hall, corridor, staircase or building.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder for the sequence.")],
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of frames.")] = 300,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of all random numbers.")] = 0,
    size: Annotated[str, typer.Option(metavar="WxH", help="Image size, pixels.")] = "640x480",
    rate: Annotated[float, typer.Option(help="Frames a second.")] = 30.0,
    speed: Annotated[float | None, typer.Option(help="Metres a second; by default that of the scene.")] = None,
    blur: Annotated[float, typer.Option(help="Motion blur: seconds the shutter is open.")] = 0.0,
    readout: Annotated[float, typer.Option(help="Rolling shutter: seconds from first to last row.")] = 0.0,
    exposure_swing: Annotated[float, typer.Option(help="Relative change of exposure over time.")] = 0.0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Render a hand-held walk through SCENE as a TUM RGB-D folder with exact ground truth."""
    from rich.console import Console
    from rich.progress import track

    from vggtgeo import simulation
    from vggtgeo.simulation.sequence import check_new, write_tum_folder

    check_new(output)  # before the slow construction of the scene
    sensor = simulation.Sensor(exposure_time=blur, readout_time=readout, exposure_swing=exposure_swing)
    console = Console(quiet=quiet or as_json)
    sequence = simulation.simulate(scene, frames, seed, parse_size(size), rate=rate, speed=speed, sensor=sensor)
    for _ in track(write_tum_folder(sequence, output), description=f"rendering {scene}", total=frames, console=console):
        pass
    length = sequence.ground_truth().length
    console.print(f"{frames} frames over {length:.1f} m of path, simulated with seed {seed}: {output}", soft_wrap=True)
    if as_json:
        facts = {"scene": scene, "frames": frames, "seed": seed, "rate": rate, "path_length_m": length}
        typer.echo(json.dumps({**facts, "folder": str(output), "simulated": True}))
