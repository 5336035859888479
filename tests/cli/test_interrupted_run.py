"""Ctrl-C in the middle of a run: what was done is written, and the exit code says so."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.simulation import simulate
from vggtgeo.simulation.sequence import write_tum_folder

FRAMES = 120
PROGRAM = "from vggtgeo.cli import main; main()"


@pytest.mark.usefixtures("uncompiled")
def test_ctrl_c_before_the_first_frame_is_no_fault_of_the_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that is interrupted before it has anything ends with code 130 too, and leaves what an earlier run wrote;
    oracle: the code, and a file that was there.
    """

    def interrupted(*_: object, **__: object) -> Iterator[object]:
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("vggtgeo.results.tracking_loop.run_frames", interrupted)
    monkeypatch.setattr("vggtgeo.slam.window.sliding_window.warm_up", lambda *_: ())  # what no frame comes to need
    (tmp_path / "trajectory.txt").write_text("of an earlier run")
    (tmp_path / "summary.json").write_text("{}")
    result = CliRunner().invoke(make_app(), ["demo", "--scene", "room", "--frames", "3", "-o", str(tmp_path), "--json"])
    assert result.exit_code == 130, result.output
    assert result.stderr.strip() == "interrupted"
    left = {file.name: file.read_text() for file in tmp_path.iterdir()}
    assert left == {"trajectory.txt": "of an earlier run", "summary.json": "{}"}


@pytest.mark.slow  # a process of its own, which compiles the window's solver
@pytest.mark.skipif(os.name != "posix", reason="signals of another kind")
def test_ctrl_c_leaves_what_was_done(tmp_path: Path) -> None:
    """SIGINT ends a real `vggtgeo run` with code 130, and trajectory, map, page, settings and summary hold the frames
    so far; oracle: the files, read back, and the number of frames that there are.
    """
    for _ in write_tum_folder(simulate("room", FRAMES, 0, (160, 120), rate=10.0), tmp_path / "room"):
        pass
    out = tmp_path / "out"
    command = [sys.executable, "-c", PROGRAM, "run", str(tmp_path / "room"), "-o", str(out), "--json"]
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment) as program:
        end = time.monotonic() + 240
        while not out.exists() and program.poll() is None and time.monotonic() < end:  # made after the compilation
            time.sleep(0.1)
        time.sleep(1.5)
        program.send_signal(signal.SIGINT)
        printed, said = program.communicate(timeout=240)
    assert program.returncode == 130, said
    assert "Traceback" not in said
    summary = json.loads((out / "summary.json").read_text())
    assert json.loads(printed) == summary
    assert summary["interrupted"] is True
    assert 0 < summary["frames"] < FRAMES
    assert len(Trajectory.load_tum(out / "trajectory.txt")) == summary["frames"]
    for name in ("keyframes.txt", "map.ply", "report.html", "settings.toml", "trajectory.png"):
        assert (out / name).stat().st_size > 0, name
    assert "interrupted" in (out / "report.html").read_text()
