"""Ctrl-C in the middle of a run: what was done is written, and the exit code says so."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app


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
