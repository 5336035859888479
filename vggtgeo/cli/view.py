"""`vggtgeo view` and `vggtgeo export`: show a finished run in a viewer or browser, or export it for other programs."""

from __future__ import annotations

import contextlib
import json
import time
import webbrowser
from pathlib import Path
from typing import Annotated, Literal

import typer

from vggtgeo.cli.options import JsonOption, QuietOption
from vggtgeo.io.errors import InputError, warn
from vggtgeo.results.output_checks import EXPORTS, check_can_be_shown, check_is_run


def view(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that a run wrote.")],
    rerun: Annotated[str, typer.Option(metavar="TARGET", help="spawn, serve, or a file ending with .rrd.")] = "spawn",
    page: Annotated[bool, typer.Option(help="Open the report and its 3D view.")] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show the run in DIR: path, map, and depth if it was saved."""
    if page:
        _open_page(folder, as_json)
        return
    from vggtgeo.viewing.entities import log_folder
    from vggtgeo.viewing.target import flush, has_screen, open_target, recording_of

    recording = recording_of(folder) if rerun in ("spawn", "serve") else None
    if recording is None:
        check_can_be_shown(folder)
    elif rerun == "spawn" and not has_screen():
        raise InputError(
            f"there is no screen; view the recording with `rerun {recording}` on a machine with a screen, or with "
            "`--rerun serve` in a browser"
        )
    opened = open_target(rerun, folder.resolve().name, folder / "view.rrd")
    if recording is None:
        log_folder(opened.stream, folder)
    else:
        opened.stream.log_file_from_path(recording)
    problem = flush(opened.stream, opened.file)
    if problem and opened.file is not None:
        raise InputError(problem)
    if problem:
        warn(problem)
    if as_json:
        typer.echo(json.dumps({"target": rerun, "shown": str(recording or folder), "url": opened.url}))
    if rerun == "serve":
        serve_until_interrupted(opened.url, quiet or as_json)


def _open_page(folder: Path, as_json: bool) -> None:
    """Open `report.html` in the browser, and print its path for machines without a browser."""
    report = (folder / "report.html").resolve()
    if not report.is_file():
        raise InputError(f"`{report}` does not exist; `vggtgeo run` writes it, and `Result.save` for a run in memory")
    opened = webbrowser.open(report.as_uri())
    typer.echo(json.dumps({"target": "page", "shown": str(report), "opened": opened}) if as_json else str(report))


def serve_until_interrupted(url: str | None, quiet: bool = False) -> None:
    """Wait until Ctrl-C while the server runs."""
    if not quiet:
        typer.echo(f"serving (Ctrl-C ends it): open {url} in a browser", err=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600.0)


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
    """Export the run in DIR for another program."""
    check_is_run(folder)
    from vggtgeo.export import export as write

    target = output or folder / EXPORTS / to
    written = write(folder, to, target)
    if as_json:
        typer.echo(json.dumps({"folder": str(target), "format": to, **written}))
    elif not quiet:
        typer.echo(f"{target}: {', '.join(_described(*item) for item in written.items())}")


def _described(name: str, value: float) -> str:
    """Return text as `3 images`, `0.42 px mean reprojection error over points`."""
    unit = " px" if name.endswith("_px") else ""
    return f"{value:.6g}{unit} {name.removesuffix('_px').replace('_', ' ')}"
