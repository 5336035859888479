"""`vggtgeo data`: the list of recordings, and sentences about what is wrong with one."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_sequences as tiny
from typer.testing import CliRunner

from vggtgeo.benchmark.suite import shipped
from vggtgeo.cli.data import catalogue
from vggtgeo.cli.main import make_app
from vggtgeo.datasets import KINDS
from vggtgeo.datasets.check import inspect


def _good(folder: Path, count: int = 6) -> Path:
    """A recording with nothing wrong: depth in a room, a truth that moves slowly."""
    tiny.tum(folder, count)
    for number, file in enumerate(sorted((folder / "depth").iterdir())):
        tiny.write_image(file, np.tile(5000 * 2 + 50 * number + np.arange(40), (30, 1)).astype(np.uint16))
    lines = [f"{10 + 0.05 * n:.3f} {0.01 * n} 0 0 0 0 0 1\n" for n in range(2 * count)]
    (folder / "groundtruth.txt").write_text("".join(lines))
    for number, file in enumerate(sorted((folder / "rgb").iterdir())):
        tiny.write_image(file, np.maximum(tiny.image(20 * number + 20), 20))
    return folder


def test_the_list_names_readers_and_suites_that_are_there() -> None:
    # Proves that every entry leads somewhere: a reader that exists, a suite that exists. Oracle: their tables.
    for entry in catalogue():
        assert set(entry["kind"].split(", ")) <= set(KINDS), entry
        assert not entry["suite"] or entry["suite"] in shipped(), entry
        assert entry["layout"]
        assert entry["licence"]
    outcome = CliRunner().invoke(make_app(), ["data", "list"])
    assert outcome.exit_code == 0, outcome.output
    assert "TUM RGB-D (--kind tum)" in outcome.stdout
    assert "vggtgeo bench 7scenes" in outcome.stdout
    listed = json.loads(CliRunner().invoke(make_app(), ["data", "list", "--json"]).stdout)
    assert len(listed) == len(catalogue())


def test_nothing_is_wrong_with_a_good_recording(tmp_path: Path) -> None:
    # Proves that a sound folder gives facts and no problem, and exit code 0. Oracle: what was written.
    folder = _good(tmp_path / "desk")
    assert inspect(folder).problems == ()
    outcome = CliRunner().invoke(make_app(), ["data", "check", str(folder)])
    assert outcome.exit_code == 0, outcome.output
    for text in ("reader: TumRgbd", "6 frames of 40 x 30", "10.0 frames a second", "truth: 12 poses, path 0.11 m"):
        assert text in outcome.stdout
    assert outcome.stdout.rstrip().endswith("no problem found")


@pytest.mark.parametrize("name", ["scene0000_00.sens", "MH_01_easy.zip"])
def test_what_is_not_unpacked_is_named(tmp_path: Path, name: str) -> None:
    # Proves that a folder with a download in it says what to do with it, as the file itself does, and that one which
    # holds it unpacked, too, says where. Oracle: the names.
    (tmp_path / name).write_bytes(b"PK\3\4")
    (tmp_path / "readme.txt").write_text("hello")
    for place in (tmp_path, tmp_path / name):
        (problem,) = inspect(place).problems
        assert name in problem
    _good(tmp_path / "unpacked")
    (problem,) = inspect(tmp_path).problems
    assert str(tmp_path / "unpacked") in problem


def _millimetres(folder: Path) -> None:
    for file in (folder / "depth").iterdir():
        codes = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        tiny.write_image(file, (codes // 100).astype(np.uint16))


def _frozen_depth(folder: Path) -> None:
    files = sorted((folder / "depth").iterdir())
    for file in files[1:]:
        file.write_bytes(files[0].read_bytes())


def _black(folder: Path) -> None:
    for file in sorted((folder / "rgb").iterdir())[2:4]:
        tiny.write_image(file, np.zeros((30, 40, 3), np.uint8))


def _gap(folder: Path) -> None:
    for name in ("rgb", "depth"):
        text = (folder / f"{name}.txt").read_text().replace("10.5", "13.5", 1)
        (folder / f"{name}.txt").write_text(text)


def _other_clock(folder: Path) -> None:
    truth = folder / "groundtruth.txt"
    lines = [line.split(maxsplit=1) for line in truth.read_text().splitlines()]
    truth.write_text("".join(f"{float(time) + 1e9:.3f} {rest}\n" for time, rest in lines))


def _jump(folder: Path) -> None:
    truth = folder / "groundtruth.txt"
    truth.write_text(truth.read_text().replace("0.05 0 0", "55.0 0 0", 1))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_millimetres, "the median depth is 0.02"),
        (_frozen_depth, "5 of 6 sampled depth images equal the previous one"),
        (_black, "2 of 6 sampled images are black"),
        (_gap, "between frames 4 and 5 the time step is"),
        (_other_clock, "no frame lies within the times of the ground truth"),
        (_jump, "m/s at 10."),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_is_wrong_is_a_sentence(tmp_path: Path, spoil, message: str) -> None:
    # Proves that each defect is told, alone, with exit code 2. Oracle: a sound recording with just that defect.
    folder = _good(tmp_path / "desk")
    spoil(folder)
    found = inspect(folder)
    assert any(message in problem for problem in found.problems), found
    outcome = CliRunner().invoke(make_app(), ["data", "check", str(folder), "--json"])
    assert outcome.exit_code == 2
    assert json.loads(outcome.stdout)["problems"] == list(found.problems)
