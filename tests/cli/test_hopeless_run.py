"""A run that nothing can come of ends in order: outputs kept, the verdict "failed", exit code 3."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tiny_sequences as tiny
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.results.result import Result


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("kind", ["black", "one picture", "unrelated pictures"])
def test_a_run_that_never_begins_says_so(tmp_path: Path, kind: str) -> None:
    """Pictures without parallax give identity poses, which nobody may take for a result: code 3, last line, summary and
    page; oracle: no motion can be had from such pictures.
    """
    rng = np.random.default_rng(0)
    for row in range(6):
        pixels = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8).repeat(20, 0).repeat(20, 1)
        if kind == "one picture":
            pixels = np.random.default_rng(1).integers(0, 255, (12, 16, 3)).astype(np.uint8).repeat(20, 0).repeat(20, 1)
        tiny.write_image(tmp_path / f"frames/{row}.png", np.zeros_like(pixels) if kind == "black" else pixels)
    tiny.write_calibration(tmp_path / "frames", (300.0, 300.0, 159.5, 119.5))
    out = tmp_path / "run"
    done = CliRunner().invoke(make_app(), ["run", str(tmp_path / "frames"), "-o", str(out)])
    assert done.exit_code == 3, done.output
    assert done.stdout.strip().splitlines()[-1] == "verdict: failed"
    summary = json.loads((out / "summary.json").read_text())
    assert next(iter(summary)) == "verdict"
    assert summary["verdict"]["level"] == "failed"
    assert "start" in summary["verdict"]["segments"][0]["checks"]
    assert "Failed:" in (out / "report.html").read_text()
    # A frame without a pose is left out: the first alone is where the world begins.
    assert len((out / "trajectory.txt").read_text().splitlines()) == 2
    assert Result.load(out).verdict.level == "failed"
