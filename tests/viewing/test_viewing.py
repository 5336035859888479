"""Where a recording is shown: viewers, files, served pages, and that nobody pays who does not ask."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import sysconfig
import time
import urllib.request
import warnings
from pathlib import Path
from urllib.parse import unquote

import pytest
from conftest import ROOT
from rrd_files import entities_of
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.io.errors import InputWarning
from vggtgeo.results.files import write_settings


def test_a_machine_without_a_screen_gets_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`spawn` without a display warns in one line that names the file, and the file holds what was logged; oracle:
    rerun's own reader.
    """
    import rerun as rr

    from vggtgeo.viewing.target import flush, open_target

    monkeypatch.setattr("vggtgeo.viewing.target.has_screen", lambda: False)
    path = tmp_path / "runs" / "run.rrd"
    with pytest.warns(InputWarning, match=r"there is no screen, so the recording is written to `.*run\.rrd`"):
        opened = open_target("spawn", "test", path)
    opened.stream.log("notes", rr.TextLog("here"))
    flush(opened.stream)
    opened.stream.disconnect()
    assert "/notes" in entities_of(path)


def test_view_names_the_recording_where_there_is_no_screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with a recording is not recorded again: the message says what to open."""
    monkeypatch.setattr("vggtgeo.viewing.target.has_screen", lambda: False)
    (tmp_path / "run.rrd").write_bytes(b"")
    result = CliRunner().invoke(make_app(), ["view", str(tmp_path)])
    assert result.exit_code == 2
    assert "with `rerun" in result.stderr


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        (None, None),
        ("serve", None),
        ("spawn", "run.rrd"),
        ("runs/x/kept.rrd", "kept.rrd"),
        ("runs/x/gone.rrd", None),
        ("killed", "view.rrd"),
    ],
)
def test_the_recording_of_an_earlier_run_is_not_shown(tmp_path: Path, target: str | None, expected: str | None) -> None:
    """Of the recordings in a folder, `view` takes the one that the folder's settings name, and none that another run
    or `view` left; without settings, as after a kill, the newest. Oracle: what was put there.
    """
    from vggtgeo.viewing.target import recording_of

    for age, name in enumerate(("view.rrd", "run.rrd", "kept.rrd")):
        (tmp_path / name).write_bytes(b"")
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    if target != "killed":
        write_settings(tmp_path / "settings.toml", {"path": "clip.mp4", "rerun": target})
    found = recording_of(tmp_path)
    assert (found and found.name) == expected


SERVE = """
import sys, rerun as rr
from vggtgeo.viewing.target import flush, open_target
opened = open_target("serve", "test", None)
opened.stream.log("notes", rr.TextLog("served"))
flush(opened.stream)
print(opened.url, flush=True)
sys.stdin.read()
"""


def test_a_served_recording_can_be_had(tmp_path: Path) -> None:
    """The address that is printed gives Rerun's page, and the source it names gives the recording; oracle: HTTP on the
    loopback, and rerun's own program as the client.
    """
    viewer = Path(sysconfig.get_path("scripts")) / "rerun"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", SERVE], cwd=ROOT, stdin=pipe, stdout=pipe, text=True) as server:
        try:
            assert server.stdout is not None
            url = server.stdout.readline().strip()
            assert url.startswith("http://localhost:"), url
            page, source = url.split("?url=")
            with urllib.request.urlopen(page, timeout=20) as answer:
                assert b"rerun" in answer.read().lower()
            saved = tmp_path / "got.rrd"
            command = [viewer, unquote(source), "--port", "auto", "--save", saved]
            with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as client:
                try:
                    assert arrives(saved, "/notes")
                finally:
                    client.kill()
        finally:
            server.communicate("", timeout=20)


def arrives(file: Path, entity: str, patience: float = 30.0) -> bool:
    """Whether the recording `file`, which is being written, comes to hold `entity`."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        time.sleep(0.2)
        with contextlib.suppress(OSError, ValueError, RuntimeError), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a file without its end
            if entity in entities_of(file):
                return True
    return False


def test_without_the_flag_rerun_is_not_imported(tmp_path: Path) -> None:
    """Neither the package nor a run's own code imports rerun; oracle: `sys.modules` of a new process."""
    script = "import sys, vggtgeo.cli.run_sequence, vggtgeo.report, vggtgeo.cli.view; print('rerun' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_view_opens_the_page_where_there_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that `--page` opens the report of the folder, and that a missing one is an error. Oracle: the address.
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: bool(opened.append(address)))
    call = ["view", str(tmp_path), "--page", "--json"]
    assert CliRunner().invoke(make_app(), call).exit_code == 2
    (tmp_path / "report.html").write_text("<p>")
    result = CliRunner().invoke(make_app(), call)
    assert result.exit_code == 0, result.output
    assert opened == [(tmp_path / "report.html").resolve().as_uri()]
    assert json.loads(result.stdout)["opened"] is False
