"""`vggtgeo run`: its options in groups, a run that nothing can come of, and Ctrl-C before the first frame."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import tiny_sequences as tiny
import typer
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.cli.options import with_option_groups
from vggtgeo.results.result import Result


@dataclass(frozen=True)
class Shape:
    width: Annotated[int, typer.Option(min=1, help="Pixels.")] = 4
    tall: Annotated[bool, typer.Option("--tall/--flat")] = False


@dataclass(frozen=True)
class Times:
    rate: Annotated[float, typer.Option("-r", "--rate")] = 30.0


def command(name: str, output: Annotated[str, typer.Option("-o")] = "out", *, shape: Shape, times: Times) -> None:
    typer.echo(repr((name, output, shape, times)))


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], ("a", "out", Shape(), Times())),
        (["--width", "7", "-r", "2"], ("a", "out", Shape(7), Times(2.0))),
        (["--tall", "-o", "b"], ("a", "b", Shape(tall=True), Times())),
    ],
)
def test_fields_are_options(flags: list[str], expected: tuple[object, ...]) -> None:
    """Options reach the fields of their group, and fields without a flag have their default; oracle: the values."""
    app = typer.Typer()
    app.command()(with_option_groups(command))
    done = CliRunner().invoke(app, ["a", *flags])
    assert done.exit_code == 0, done.output
    assert done.stdout.strip() == repr(expected)


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("kind", ["black", "one picture", "unrelated pictures"])
def test_a_run_that_never_begins_says_so(tmp_path: Path, kind: str) -> None:
    """Pictures without parallax give identity poses, which nobody may take for a result: code 3, last line, summary and
    page; oracle: no motion can be had from such pictures.
    """
    rng = np.random.default_rng(1)
    for row in range(6):
        pixels = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8).repeat(20, 0).repeat(20, 1)
        rng = np.random.default_rng(1) if kind == "one picture" else rng
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
