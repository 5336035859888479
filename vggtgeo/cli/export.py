"""`vggtgeo export`: a finished run as files for other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from vggtgeo.cli.options import JsonOption, QuietOption
from vggtgeo.results.unfinished import EXPORTS, check_is_run


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that a run wrote.")],
    to: Annotated[
        Literal["colmap", "nerfstudio", "ply", "glb", "las", "tum", "kitti"], typer.Option(help="The format.")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the files; by default DIR/export/FORMAT.")
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the run in DIR for another program."""
    check_is_run(folder)
    from vggtgeo.export import export as write

    target = output or folder / EXPORTS / to
    written = write(folder, to, target)
    if as_json:
        typer.echo(json.dumps({"folder": str(target), "format": to, **written}))
    elif not quiet:
        typer.echo(f"{target}: {', '.join(_in_words(*item) for item in written.items())}")


def _in_words(name: str, value: float) -> str:
    """Return text as `3 images`, `0.42 px mean reprojection error over points`."""
    unit = " px" if name.endswith("_px") else ""
    return f"{value:.6g}{unit} {name.removesuffix('_px').replace('_', ' ')}"
