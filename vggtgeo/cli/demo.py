"""`vggtgeo demo`: a run in a synthetic office, rendered on the spot."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from vggtgeo.cli.options import AssignmentsOption, ReportOptions, RerunOption, with_option_groups
from vggtgeo.cli.run_options import ResultOptions, ResumeOption
from vggtgeo.cli.settings_file import SettingsOption, pipeline_settings

SIZE = (480, 360)
"""Pixels: large enough for a dense map, small enough to render during the run."""


@dataclass(frozen=True)
class SceneOptions:
    """The simulated scene."""

    scene: Annotated[str, typer.Option(help="Scene: office, hall, corridor, staircase, building, room.")] = "office"
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of frames.")] = 45
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the scene and its noise.")] = 0


@with_option_groups
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")] = Path("runs/demo"),
    settings: SettingsOption = None,
    *,
    world: SceneOptions,
    assignments: AssignmentsOption = None,
    rerun: RerunOption = None,
    resume: ResumeOption = None,
    report: ReportOptions,
) -> None:
    """Run in a synthetic office with exact truth, rendered on the spot."""
    from vggtgeo.cli.run_sequence import run_and_write
    from vggtgeo.results.run_options import RunOptions
    from vggtgeo.simulation import simulate
    from vggtgeo.slam.settings.slam_settings import Roles
    from vggtgeo.slam.window.sliding_window import warm_up
    from vggtgeo.viewing.target import check_target

    if rerun:
        check_target(rerun)
    slam_settings = pipeline_settings(settings, assignments or (), {})
    # While the light of the scene is computed, what every window needs is compiled.
    with ThreadPoolExecutor(1, thread_name_prefix="compile") as pool:
        compiled = pool.submit(warm_up, slam_settings)
        sequence = simulate(world.scene, world.frames, world.seed, rate=10.0, size=SIZE)
        compiled.result()
    if not (report.quiet or report.as_json):
        typer.echo(f"simulated scene `{world.scene}`: all results below are from a simulation")
    run_and_write(
        sequence,
        Roles(),
        slam_settings,
        output,
        ResultOptions(rerun=rerun, resume=resume, quiet=report.quiet, as_json=report.as_json),
        RunOptions(title=f"simulated {world.scene}", facts={"simulated": True}),
        flags=settings.values() if settings else {},
    )
