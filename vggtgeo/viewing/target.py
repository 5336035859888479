"""Where a recording goes: a file, a viewer on this machine, or a port that a browser connects to."""

from __future__ import annotations

import ctypes
import os
import socket
import sys
import sysconfig
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import make_parent, whole_path
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
_STANDSTILL = 5.0
"""Seconds in which a file that is being written grows, on a slow disk, too."""
_SOME = 2**20
"""Bytes that a disk with room takes; what Rerun writes first is 30 kB."""


@dataclass(frozen=True, eq=False)
class Opened:
    """A target that is open: `stream` takes what is logged; `url` is where a browser shows a served one, `file` what is
    written where no viewer listens.
    """

    stream: Any
    url: str | None = None
    file: Path | None = None


def check_target(target: str) -> str:
    """`target` itself; InputError unless it is `spawn`, `serve` or a file name that ends with `.rrd`."""
    if target not in ("spawn", "serve") and Path(target).suffix != ".rrd":
        raise InputError(
            f"`--rerun` is {target!r}; it must be `spawn` (a window), `serve` (a browser) or a file ending with `.rrd`"
        )
    if "://" in target:
        raise InputError(
            f"`--rerun` is `{target}`, an address; give a file, or `serve`, which says where a viewer can connect"
        )
    if Path(target).is_dir():
        raise InputError(f"`--rerun` is `{target}`, which is a folder; give a new file ending with `.rrd`")
    if whole_path(Path(target)).is_symlink():  # Rerun would tell it in words of its own, after a second
        raise InputError(f"`--rerun` is `{target}`, a link that leads nowhere; give a new file ending with `.rrd`")
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
    url = file = None
    if check_target(target) == "spawn":
        file = _spawn(stream, instead)
    elif target == "serve":
        url = _serve(stream)
    else:
        file = _save(stream, Path(target))
    stream.send_recording_name(name)
    return Opened(stream, url, file)


def flush(stream: Any, file: Path | None = None) -> str:
    """Waits until everything that was logged has arrived; says what went wrong, in a sentence, empty where nothing did.

    Args:
        stream: as `open_target` gives it.
        file: where it goes, if that is a file.

    """
    reason = _unsent(stream, _PATIENCE) if file is None else _unwritten(stream, file)
    if not reason or file is None:
        return reason and f"the Rerun viewer did not take all of the recording ({reason})"
    return f"the recording `{file}` is cut short: {reason}; make room there, or give another file"


def has_screen() -> bool:
    """Whether a window can be opened, as far as the environment tells."""
    if sys.platform in ("win32", "darwin"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"))


def _save(stream: Any, path: Path) -> Path:
    """The file, asked for first whether the disk takes it: else Rerun may wait for ever, see `_unwritten`."""
    make_parent(path)
    try:
        reason = _refused(path.parent)
        if not reason:
            stream.save(path, default_blueprint=blueprint())
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
    if reason:
        raise InputError(f"`--rerun` is `{path}`, which cannot be written: {reason}")
    return path


def _unsent(stream: Any, seconds: float) -> str:
    try:
        stream.flush(timeout_sec=seconds)
    except RuntimeError as error:
        return str(error).splitlines()[0]
    return ""


def _unwritten(stream: Any, file: Path) -> str:
    """Why the file is not whole.

    Rerun's thread that writes it ends at the first error. A flush that was sent before is then never answered
    (rerun-sdk 0.41), and whatever ends the stream waits for that one. So once the file no longer grows, it is given up.
    """
    size = -1
    while reason := _unsent(stream, _STANDSTILL):
        before, size = size, file.stat().st_size if file.is_file() else 0
        if size <= before:
            _leave_open(stream)
            return _refused(file.parent) or reason
    return ""


def _leave_open(stream: Any) -> None:
    """Rerun waits neither at the end of the program nor where the stream is deleted: one reference more keeps it."""
    import rerun as rr

    rr.unregister_shutdown()
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(stream))


def _refused(folder: Path) -> str:
    """What the system says of one more file there; empty where it takes it."""
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(_SOME))
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _spawn(stream: Any, instead: Path) -> Path | None:
    """A window, or the file `instead` where none opens."""
    reason = "there is no screen" if not has_screen() else _start_viewer(stream)
    if reason is None:
        stream.connect_grpc(default_blueprint=blueprint())
        return None
    _save(stream, instead)
    warnings.warn(
        f"{reason}, so the recording goes to `{instead}`; look at it with `rerun {instead}` where there is one, or "
        "with `--rerun serve` in a browser",
        InputWarning,
        stacklevel=2,
    )
    return instead


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
