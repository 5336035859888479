"""`vggtgeo simulate`: a synthetic scene as a TUM RGB-D folder; `vggtgeo warm-up`: compile before the first run."""

import json
from pathlib import Path
from typing import Annotated

import typer

from vggtgeo.cli.options import JsonOption, QuietOption
from vggtgeo.io.errors import InputError


def simulate(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="room, office, hall, corridor, staircase or building.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder for the sequence.")],
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of frames.")] = 300,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Decides everything that is random.")] = 0,
    size: Annotated[str, typer.Option(metavar="WxH", help="Image size, pixels.")] = "640x480",
    rate: Annotated[float, typer.Option(help="Frames a second.")] = 30.0,
    speed: Annotated[float | None, typer.Option(help="Metres a second; the scene's own if left out.")] = None,
    blur: Annotated[float, typer.Option(help="Motion blur: seconds the shutter is open.")] = 0.0,
    readout: Annotated[float, typer.Option(help="Rolling exposure: seconds from first to last row.")] = 0.0,
    exposure_swing: Annotated[float, typer.Option(help="Relative change of exposure over time.")] = 0.0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Render a hand-held walk through SCENE as a TUM RGB-D folder with exact truth."""
    from rich.console import Console
    from rich.progress import track

    from vggtgeo import simulation
    from vggtgeo.simulation.sequence import check_new, write_tum_folder

    check_new(output)  # before a world is built
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


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) of a text like 640x480; raise InputError for anything else."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise InputError(f"`--size` must be two integers, as in 640x480, got {text!r}") from None
    if min(width, height) < 16 or max(width, height) > 8192:
        raise InputError(f"`--size` must have sides of 16 to 8192 pixels, got {text!r}")
    return width, height


def warm_up(
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the images with depth, pixels.")] = "640x480",
) -> None:
    """Compile what runs with default settings need, into the cache; takes some minutes once."""
    width, height = parse_size(size)

    from vggtgeo.slam.global_map.compile_ahead import compile_before_runs
    from vggtgeo.slam.settings.slam_settings import SlamSettings

    compile_before_runs(SlamSettings(), width, height)
