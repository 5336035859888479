"""Open the target of a recording (a file, a local viewer, a web server), and find the recording of a past run."""

from __future__ import annotations

import os
import socket
import sys
import sysconfig
import tempfile
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from vggtgeo.io.errors import InputError, warn
from vggtgeo.io.files import whole_text

APPLICATION = "vggtgeo"
FALLBACK_FILE = "run.rrd"
"""File in the run's folder that is recorded if no viewer can be opened."""
VIEWER_PORT = 9876
"""Default port of the viewer, and of a served recording."""
WEB_PORT = 9090
"""Default port of the page that shows a served recording."""
_TIMEOUT = 10.0
"""Maximum seconds to wait until a viewer is open, and until it has received all data."""
_PROBE_SIZE = 2**20
"""Bytes written to test whether the disk has space; Rerun's first write is 30 kB."""


@dataclass(frozen=True, eq=False)
class OpenTarget:
    """An open target. stream: to log to. url: of a served recording. file: that is written, if any."""

    stream: Any
    url: str | None = None
    file: Path | None = None


def check_target(target: str) -> str:
    """Return `target`; raise InputError unless it is `spawn`, `serve` or a file name that ends with `.rrd`."""
    if target not in ("spawn", "serve") and Path(target).suffix != ".rrd":
        raise InputError(
            f"`--rerun` must be `spawn` (a window), `serve` (a browser) or a file ending with `.rrd`, got {target!r}"
        )
    return target


def open_target(target: str, name: str, fallback: Path) -> OpenTarget:
    """Open a stream to `target`, with the blueprint of this package.

    A file is written continuously, so that the recording of an interrupted run can be opened.

    Args:
        target: `spawn`, `serve` or a file, see `check_target`.
        name: of the recording.
        fallback: file to write, with a warning, if no viewer can be opened.

    """
    import rerun as rr

    stream = rr.RecordingStream(APPLICATION)
    url = file = None
    if check_target(target) == "spawn":
        file = _spawn(stream, fallback)
    elif target == "serve":
        url = _serve(stream)
    else:
        file = _save(stream, Path(target))
    stream.send_recording_name(name)
    return OpenTarget(stream, url, file)


def recording_of(folder: Path) -> Path | None:
    """Return the recording that the run in `folder` made there; None without one.

    The run's settings name it, which excludes recordings of earlier runs. A killed run has no settings: then it is the
    newest recording in the folder.
    """
    try:
        target = tomllib.loads(whole_text(folder / "settings.toml", errors="strict")).get("rerun")
    except (ValueError, RecursionError):
        return max(folder.glob("*.rrd"), key=lambda file: file.stat().st_mtime, default=None)
    if target is None:
        return None
    file = folder / (FALLBACK_FILE if target == "spawn" else Path(str(target)).name)
    return file if file.suffix == ".rrd" and file.is_file() else None


def flush(stream: Any, file: Path | None = None) -> str:
    """Wait until all data has been sent or written; return an error message, empty on success.

    Args:
        stream: of `open_target`.
        file: of the stream, if any.

    """
    try:
        stream.flush(timeout_sec=_TIMEOUT)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        if file is None:
            return f"the Rerun viewer did not receive all of the recording ({reason})"
        return f"the recording `{file}` is incomplete: {reason}; free disk space, or give another file"
    return ""


def has_screen() -> bool:
    """Return whether a window can be opened, by the environment variables."""
    if sys.platform in ("win32", "darwin"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"))


def _save(stream: Any, path: Path) -> Path:
    """Record to a file, after a test that the disk has space: on a full disk Rerun may never return."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryFile(dir=path.parent) as probe:
            probe.write(bytes(_PROBE_SIZE))
        stream.save(path, default_blueprint=blueprint())
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise InputError(f"`--rerun` must be a writable file, got `{path}`: {reason}") from None
    return path


def _spawn(stream: Any, fallback: Path) -> Path | None:
    """Open a viewer, or record to the file `fallback` if that fails."""
    reason = "there is no screen" if not has_screen() else _start_viewer(stream)
    if reason is None:
        stream.connect_grpc(default_blueprint=blueprint())
        return None
    _save(stream, fallback)
    warn(
        f"{reason}, so the recording is written to `{fallback}`; view it with `rerun {fallback}` on a machine with a "
        "screen, or use `--rerun serve` for a browser"
    )
    return fallback


def _start_viewer(stream: Any) -> str | None:
    """Start the viewer, or find a running one; return an error message if that fails."""
    path = os.environ.get("PATH", "")
    # The viewer is installed in Python's folder of scripts, which need not be in PATH.
    os.environ["PATH"] = os.pathsep.join([sysconfig.get_path("scripts"), path])
    try:
        stream.spawn(connect=False)
    except RuntimeError as error:
        return f"the viewer did not start ({str(error).splitlines()[0]})"
    finally:
        os.environ["PATH"] = path
    end = time.monotonic() + _TIMEOUT
    while time.monotonic() < end:
        if _listens(VIEWER_PORT):
            return None
        time.sleep(0.1)
    return "the viewer did not answer"


def _serve(stream: Any) -> str:
    """Serve the recording and a web viewer, at the default ports or at free ones; return the URL."""
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


def _port(default: int) -> int:
    """Return the port `default` if it is free, else another free port."""
    with socket.socket() as probe:
        if os.name == "posix":  # Rerun's server sets this option, too: a recently closed port counts as free
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", default))
        except OSError:
            probe.bind(("", 0))
        return int(probe.getsockname()[1])


def blueprint() -> Any:
    """Return the layout of the views: world and curves on the left, current frame and keyframe on the right."""
    import rerun.blueprint as rrb

    world = rrb.Spatial3DView(
        name="World: path, map, covariance ellipsoids of 20 sigma",
        origin="/world",
        line_grid=rrb.LineGrid3D(visible=False),
    )
    pictures = rrb.Tabs(
        rrb.Spatial2DView(name="Matches and lines", origin="/keyframe/image"),
        rrb.Spatial2DView(name="Depth", origin="/keyframe/depth"),
        rrb.Spatial2DView(name="Confidence", origin="/keyframe/confidence"),
        rrb.GraphView(name="Window and covisibility", origin="/window"),
        name="Keyframe",
    )
    now = rrb.Spatial2DView(name="Frame", origin="/world/camera/image")
    curves = rrb.Tabs(
        rrb.TimeSeriesView(name="Residuals [px], depth [sigma]", origin="/plots/residuals"),
        rrb.TimeSeriesView(name="Energy by iteration", origin="/plots/solver"),
        rrb.TimeSeriesView(name="Damping, gradient, step [m]: log10", origin="/plots/convergence"),
        rrb.TimeSeriesView(name="Tracked points", origin="/plots/tracking"),
        rrb.TextLogView(name="Notes", origin="/notes"),
    )
    left = rrb.Vertical(world, curves, row_shares=[3, 1])
    right = rrb.Vertical(now, pictures, row_shares=[1, 1])
    time = rrb.TimePanel(timeline="frame", play_state="following")  # opens at the end, with the whole map
    return rrb.Blueprint(rrb.Horizontal(left, right, column_shares=[2, 1]), time, collapse_panels=True)
