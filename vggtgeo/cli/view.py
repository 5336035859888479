"""`vggtgeo view`: a finished run in the Rerun viewer."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Annotated

import typer


def view(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that a run wrote.")],
    rerun: Annotated[
        str, typer.Option(metavar="TARGET", help="spawn, serve, or a new file ending with .rrd.")
    ] = "spawn",
) -> None:
    """Show the run in DIR: path, map, and depth where it was saved."""
    from vggtgeo.errors import InputError
    from vggtgeo.viewing.target import check_target, open_target

    check_target(rerun)
    if not folder.is_dir():
        raise InputError(f"`{folder}` is no folder; give the folder that `vggtgeo run -o` wrote")
    recordings = sorted(folder.glob("*.rrd"))
    stream = open_target(rerun, folder.resolve().name)
    if recordings and Path(rerun).suffix != ".rrd":
        stream.log_file_from_path(recordings[-1])
        stream.flush()
    else:
        from vggtgeo.viewing.folder import log_folder

        log_folder(stream, folder)
    if rerun == "serve":
        serve_until_interrupted()


def serve_until_interrupted() -> None:
    """Waits until Ctrl-C, so that a browser may go on reading."""
    typer.echo("serving (Ctrl-C ends it): open http://localhost:9090 in a browser", err=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600.0)
