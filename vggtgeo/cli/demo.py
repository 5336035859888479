"""`vggtgeo demo`: the main job on a synthetic room, rendered on the spot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vggtgeo.cli.run import make_roles, run_and_write
from vggtgeo.simulation import simulate
from vggtgeo.slam.settings import SlamSettings


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")] = Path("runs/demo"),
    scene: Annotated[str, typer.Option(help="Synthetic scene.")] = "room",
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 60,
    seed: Annotated[int, typer.Option(help="Seed of the scene and its noise.")] = 0,
) -> None:
    """Run on a synthetic room with exact truth, rendered on the spot."""
    sequence = simulate(scene, frames, seed, rate=10.0)
    flags = {"scene": scene, "frames": frames, "seed": seed, "simulated": True}
    roles = make_roles(sequence, "pnp", "sift")
    typer.echo(f"simulated scene `{scene}`: all numbers below are of a simulation")
    run_and_write(sequence, roles, SlamSettings(), output, flags, (0, None, 1), label=f"simulated {scene}")
