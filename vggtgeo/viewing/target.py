"""Where a recording goes: a file, a viewer on this machine, or a port that a browser connects to."""

from __future__ import annotations

import os
import socket
import sys
import sysconfig
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import make_parent
from vggtgeo.viewing.blueprint import blueprint

APPLICATION = "vggtgeo"
STAND_IN = "run.rrd"
"""In the run's folder: the recording of a run whose window could not open."""
VIEWER_PORT = 9876
"""Where the viewer listens, and where a served recording is to be had if the port is free."""
WEB_PORT = 9090
"""The same of the page that shows a served recording."""
_MAGIC = b"RRF"
_PATIENCE = 10.0
"""Seconds: for a viewer to open, and for it to take what was logged last."""


@dataclass(frozen=True, eq=False)
class Opened:
    """A target that is open: `stream` takes what is logged; `url` is where a browser shows a served one."""

    stream: Any
    url: str | None = None


def check_target(target: str) -> str:
    """`target` itself; InputError unless it is `spawn`, `serve` or a file name that ends with `.rrd`."""
    if target not in ("spawn", "serve") and Path(target).suffix != ".rrd":
        raise InputError(
            f"`--rerun` is {target!r}; it must be `spawn` (a window), `serve` (a browser) or a file ending with `.rrd`"
        )
    if Path(target).is_dir():
        raise InputError(f"`--rerun` is `{target}`, which is a folder; give a new file ending with `.rrd`")
    if Path(target).is_file() and not _is_recording(Path(target)):
        raise InputError(f"`--rerun` is `{target}`, which is there and is no recording; give the name of a new file")
    return target


def _is_recording(file: Path) -> bool:
    """Whether Rerun wrote the file, so that a new recording may take its place."""
    with file.open("rb") as handle:
        return handle.read(len(_MAGIC)) in (_MAGIC, b"")


def open_target(target: str, name: str, instead: Path) -> Opened:
    """A stream that sends what is logged to `target`, arranged by the blueprint of this package.

    A file grows while the run goes on, so that an interrupted run leaves one that opens.

    Args:
        target: `spawn`, `serve` or a file, as `check_target` takes it.
        name: of the recording.
        instead: the file that is written in place of a window where there is no screen, with a warning.

    """
    import rerun as rr

    stream = rr.RecordingStream(APPLICATION)
    url = None
    if check_target(target) == "spawn":
        _spawn(stream, instead)
    elif target == "serve":
        url = _serve(stream)
    else:
        _save(stream, Path(target))
    stream.send_recording_name(name)
    return Opened(stream, url)


def flush(stream: Any) -> None:
    """Waits until everything that was logged has arrived; a viewer that is gone costs a warning, never the run."""
    try:
        stream.flush(timeout_sec=_PATIENCE)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        warnings.warn(f"the Rerun viewer did not take all of the recording ({reason})", InputWarning, stacklevel=2)


def has_screen() -> bool:
    """Whether a window can be opened, as far as the environment tells."""
    if sys.platform in ("win32", "darwin"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"))


def _save(stream: Any, path: Path) -> None:
    make_parent(path)
    try:
        stream.save(path, default_blueprint=blueprint())
    except RuntimeError as error:
        raise InputError(f"`--rerun` is `{path}`, which cannot be written: {str(error).splitlines()[0]}") from None


def _spawn(stream: Any, instead: Path) -> None:
    """A window, or the file `instead` where none opens."""
    reason = "there is no screen" if not has_screen() else _start_viewer(stream)
    if reason is None:
        stream.connect_grpc(default_blueprint=blueprint())
        return
    _save(stream, instead)
    warnings.warn(
        f"{reason}, so the recording goes to `{instead}`; look at it with `rerun {instead}` where there is one, or "
        "with `--rerun serve` in a browser",
        InputWarning,
        stacklevel=2,
    )


def _start_viewer(stream: Any) -> str | None:
    """Start the viewer, or find one that runs; says why where there is none in the end."""
    path = os.environ.get("PATH", "")
    # The viewer's program lies beside Python, which is not on the path of whoever calls it by its whole name.
    os.environ["PATH"] = os.pathsep.join([sysconfig.get_path("scripts"), path])
    try:
        stream.spawn(connect=False)
    except RuntimeError as error:
        return f"the viewer did not start ({str(error).splitlines()[0]})"
    finally:
        os.environ["PATH"] = path
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        if _listens(VIEWER_PORT):
            return None
        time.sleep(0.1)
    return "the viewer closed at once"


def _serve(stream: Any) -> str:
    """A page and the recording behind it, at the usual ports or at free ones."""
    import rerun as rr

    source = stream.serve_grpc(grpc_port=_port(VIEWER_PORT), default_blueprint=blueprint())
    web = _port(WEB_PORT)
    rr.serve_web_viewer(web_port=web, open_browser=False)
    source = source.replace("127.0.0.1", "localhost")
    return f"http://localhost:{web}/?url={quote(source, safe=':/')}"


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _port(usual: int) -> int:
    """`usual` if it is free, else one that is."""
    with socket.socket() as probe:
        if os.name == "posix":  # as the server itself does: a port that was just given up is free
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", usual))
        except OSError:
            probe.bind(("", 0))
        return int(probe.getsockname()[1])
