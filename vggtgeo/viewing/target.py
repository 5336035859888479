"""Where a recording goes: a file, a viewer on this machine, or a port that a viewer elsewhere connects to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vggtgeo.errors import InputError
from vggtgeo.files import make_parent

APPLICATION = "vggtgeo"


def check_target(target: str) -> str:
    """`target` itself; InputError unless it is `spawn`, `serve` or a file name that ends with `.rrd`."""
    if target not in ("spawn", "serve") and Path(target).suffix != ".rrd":
        raise InputError(
            f"`--rerun` is {target!r}; it must be `spawn` (a window), `serve` (a browser) or a file ending with `.rrd`"
        )
    return target


def open_target(target: str, name: str) -> Any:
    """A stream that sends what is logged to `target`, arranged by the blueprint of this package.

    A file grows while the run goes on, so that an interrupted run leaves one that opens.
    """
    import rerun as rr

    from vggtgeo.viewing.blueprint import blueprint

    stream = rr.RecordingStream(APPLICATION)
    if check_target(target) == "spawn":
        stream.spawn(default_blueprint=blueprint())
    elif target == "serve":
        rr.serve_web_viewer(connect_to=stream.serve_grpc(default_blueprint=blueprint()), open_browser=False)
    else:
        make_parent(Path(target))
        stream.save(target, default_blueprint=blueprint())
    stream.send_recording_name(name)
    return stream
