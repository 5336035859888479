"""`vggtgeo warm-up`: compile before the first run."""

from typing import Annotated

import typer

from vggtgeo.cli.simulate import parse_size


def warm_up(
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the images with depth, pixels.")] = "640x480",
) -> None:
    """Compile what runs with default settings need, into the cache; takes some minutes once."""
    width, height = parse_size(size)

    from vggtgeo.slam.global_map.compile_ahead import compile_before_runs
    from vggtgeo.slam.settings.slam_settings import SlamSettings

    compile_before_runs(SlamSettings(), width, height)
