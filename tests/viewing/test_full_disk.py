"""A recording whose disk gets full ends in a sentence, not in waiting for ever."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from unittest.mock import MagicMock

import bad_files as bad
import numpy as np
import pytest
from conftest import ROOT
from recorded_run import recorded_run

from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import InputWarning
from vggtgeo.viewing import target
from vggtgeo.viewing.callback import RerunCallback

# No byte code: Python 3.11 keeps a compiled module that the limit cut short, and every later process fails on it.
VIEW = """
import resource, sys
sys.dont_write_bytecode = True
from vggtgeo.cli.main import main
from vggtgeo.viewing import target
target._STALL_TIMEOUT = 0.5
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)), -1))
main()
"""


@pytest.mark.parametrize(
    ("room", "said"),
    [
        (20_000, "which cannot be written: File too large"),
        pytest.param(2_000_000, "is incomplete: ", marks=pytest.mark.long),
    ],
)
def test_view_ends_where_the_disk_is_full(room: int, said: str, tmp_path: Path) -> None:
    """With room for `room` bytes of 2.4 million, `view` ends by itself with code 2, and its last line names the file
    (Rerun's own thread waited for ever, and signals with it). Oracle: the sentence, and the clock.
    """
    for name in ("trajectory", "keyframes"):
        bad.walk(tmp_path / f"{name}.txt", 0)
    points = np.random.default_rng(0).normal(size=(200_000, 3))
    PointCloud(points, np.zeros((len(points), 3), np.uint8)).save_ply(tmp_path / "map.ply")
    command = [sys.executable, "-c", VIEW, str(room), "view", str(tmp_path), "--rerun", str(tmp_path / "v.rrd")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("error: "), done.stderr
    assert "v.rrd`" in last, last
    assert said in last, last


def test_a_file_that_grows_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow disk is no full one: while the file grows, the flush is asked for again; one that stands still is given
    up. Oracle: the number of flushes by hand.
    """
    monkeypatch.setattr(target, "_abandon", lambda stream: None)
    file = tmp_path / "run.rrd"
    stream = MagicMock()
    left = [b"a", b"b", b"c"]

    def slow(timeout_sec: float) -> None:
        if left:
            with file.open("ab") as handle:
                handle.write(left.pop())
            raise RuntimeError("Flush timed out")

    stream.flush.side_effect = slow
    assert target.flush(stream, file) == ""
    assert stream.flush.call_count == 4
    stream.flush.side_effect = RuntimeError("Flush timed out")
    assert "run.rrd` is incomplete: Flush timed out" in target.flush(stream, file)
    assert stream.flush.call_count == 6


@pytest.mark.parametrize("file", [None, Path("run.rrd")])
def test_a_recording_that_fails_costs_a_run_a_warning(file: Path | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of a run the reason is told, and only a file counts as cut short; oracle: the stream's error."""
    monkeypatch.setattr(target, "_abandon", lambda stream: None)
    stream = MagicMock()
    stream.flush.side_effect = RuntimeError("it is gone")
    run = recorded_run()
    callback = RerunCallback(stream, file=file)
    with pytest.warns(InputWarning, match="it is gone"):
        callback.on_finish(run.slam, run.cloud)
    assert callback.cut_short == (file is not None)
