"""`vggtgeo demo`: the main job in a synthetic office, rendered on the spot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from vggtgeo.cli.options import EXIT_FAILED, EXIT_INTERRUPTED, JsonOption, QuietOption, RerunOption
from vggtgeo.cli.settings_file import SettingsOption
from vggtgeo.cli.view import serve_until_interrupted


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")] = Path("runs/demo"),
    settings: SettingsOption = None,
    scene: Annotated[str, typer.Option(help="Synthetic scene: office, hall, corridor, staircase, room.")] = "office",
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 60,
    seed: Annotated[int, typer.Option(help="Seed of the scene and its noise.")] = 0,
    rerun: RerunOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run in a synthetic office with exact truth, rendered on the spot."""
    from vggtgeo.cli.run import make_roles
    from vggtgeo.cli.run_sequence import run_and_write
    from vggtgeo.simulation import simulate
    from vggtgeo.slam.settings import SlamSettings
    from vggtgeo.viewing.target import check_target

    rerun = check_target(rerun) if rerun else None
    quiet = quiet or as_json
    sequence = simulate(scene, frames, seed, rate=10.0)
    roles = make_roles(sequence, "pnp", "sift")
    if not quiet:
        typer.echo(f"simulated scene `{scene}`: all numbers below are of a simulation")
    finished = run_and_write(
        sequence,
        roles,
        SlamSettings(),
        output,
        settings.values() if settings else {},
        (0, None, 1),
        quiet=quiet,
        label=f"simulated {scene}",
        rerun=rerun,
        facts=lambda: {"simulated": True},
    )
    if as_json:
        typer.echo(json.dumps(json.loads((output / "summary.json").read_text())))
    if rerun == "serve":
        serve_until_interrupted(finished.url, quiet)
    if finished.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)
    if finished.verdict.level == "failed":
        raise typer.Exit(EXIT_FAILED)
