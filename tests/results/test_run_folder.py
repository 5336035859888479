"""The folder of a run: one run's files or another's, whatever signal comes and whenever it does."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_sequences as tiny
from reported import raises, warns
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import LockedError, locked
from vggtgeo.io.process import end_on_signals
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.results.files import write_depth
from vggtgeo.results.output_checks import unfinished_message
from vggtgeo.results.result import Result
from vggtgeo.results.run_folder import RESERVE, open_run_folder

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="signals of another kind"),
    pytest.mark.usefixtures("uncompiled"),
]
FRAMES = 6


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """The signals as the program's entry has them."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)}
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts jobs in the background without it
    end_on_signals()
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A folder of images of one place."""
    pixels = np.random.default_rng(1).integers(0, 255, (12, 16, 3)).astype(np.uint8).repeat(10, 0).repeat(10, 1)
    for row in range(FRAMES):
        tiny.write_image(tmp_path / f"frames/{row}.png", pixels)
    tiny.write_calibration(tmp_path / "frames", (150.0, 150.0, 79.5, 59.5))
    return tmp_path / "frames"


def old_run(folder: Path) -> dict[str, bytes]:
    """What an earlier run left in `folder`."""
    (folder / "depth").mkdir(parents=True)
    for name in ("trajectory.txt", "keyframes.txt", "map.ply", "report.html", "depth/000000.depth.png", "run.rrd"):
        (folder / name).write_text("of the run before")
    (folder / "summary.json").write_text('{"frames": 4711}')
    (folder / "settings.toml").write_text('rerun = "run.rrd"\n')
    (folder / "notes.txt").write_text("the user's own")
    return contents(folder)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def call(frames: Path, out: Path, *more: str):
    return CliRunner().invoke(make_app(), ["run", str(frames), "-o", str(out), *more])


def check_one_run(out: Path, frames: int, interrupted: bool) -> None:
    """All files are of one run of so many frames, and nothing of an earlier one is among them."""
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"] == frames
    assert ("interrupted" in (out / "report.html").read_text()) == summary["interrupted"] == interrupted
    for file in out.rglob("*"):
        if file.is_file() and file.name != "notes.txt":
            assert file.read_bytes() != b"of the run before", file
    assert (out / "notes.txt").read_text() == "the user's own"
    assert sorted(path.name for path in out.iterdir() if path.name not in ("notes.txt", "trajectory.png")) == [
        "images",
        "keyframes.txt",
        "map.ply",
        "report.html",
        "scene.npz",
        "settings.toml",
        "summary.json",
        "trajectory.txt",
    ]


STAGES = (
    "vggtgeo.results.reconstruction.finish",
    "vggtgeo.results.reconstruction.dense_map",
    "vggtgeo.results.reconstruction.judge_or_report",
    "vggtgeo.results.result.write_settings",
    "vggtgeo.results.result.write_json",
    "vggtgeo.results.result.write_page",
    "vggtgeo.results.run_folder.os.replace",
)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.rpartition(".")[2])
def test_a_signal_at_any_stage_leaves_one_run(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    """SIGTERM in the last adjustment, while the map is made or between two files of the result: the folder holds the
    new run as a whole, labelled as its summary says; oracle: every file of it. The test below has all signals.
    """
    out = tmp_path / "out"
    old_run(out)
    module, _, name = stage.rpartition(".")
    owner = os if module.endswith(".os") else importlib.import_module(module)
    real, sent = getattr(owner, name), []

    def signalled(*arguments: object, **options: object) -> object:
        if not sent and (name != "replace" or Path(str(arguments[1])).parent == out):
            sent.append(signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)
        return real(*arguments, **options)

    monkeypatch.setattr(owner, name, signalled)
    done = call(frames, out)
    assert sent
    assert done.exit_code == (130 if name == "finish" else 3), done.output
    check_one_run(out, FRAMES, interrupted=name == "finish")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP], ids=lambda number: number.name)
def test_a_signal_between_frames_keeps_what_is_done(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """The frame at hand is finished, the rest left out, code 130, all files say so; oracle: the count of frames."""
    from vggtgeo.slam import run as fold

    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip(f"{number.name} is ignored here, as under nohup, and so by the program")
    out, real, count = tmp_path / "out", fold.step, []

    def step(*arguments: object) -> object:
        count.append(1)
        if len(count) == 3:
            os.kill(os.getpid(), number)
        return real(*arguments)

    monkeypatch.setattr("vggtgeo.slam.run.step", step)
    old_run(out)
    done = call(frames, out)
    assert done.exit_code == 130, done.output
    check_one_run(out, 3, interrupted=True)


def test_a_second_signal_ends_at_once_and_the_old_run_stays(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who presses Ctrl-C twice gets out, and the folder is as it was, with the poses beside; oracle: the old files."""

    def stuck(*_: object, **__: object) -> None:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)

    out = tmp_path / "out"
    before = old_run(out)
    monkeypatch.setattr("vggtgeo.results.result.write_page", stuck)
    assert call(frames, out).exit_code == 130
    after = contents(out)
    assert {name: after[name] for name in before} == before
    assert "unfinished/trajectory.txt" in after
    assert not (out / ".lock").exists()
    with warns("unfinished"), pytest.raises(InputError):
        Result.load(out)


def test_the_lock_of_a_killed_run_is_given_back(tmp_path: Path) -> None:
    """A process that is killed while it holds the folder leaves its lock file, and the next run takes the folder;
    oracle: SIGKILL of a real process.
    """
    out = tmp_path / "out"
    code = f"""
from vggtgeo.results.run_folder import open_run_folder
with open_run_folder({str(out)!r}) as run:
    (run.stage / "trajectory.txt").write_text("half")
    print("taken", flush=True)
    input()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"taken\n"
        with raises(out), open_run_folder(out):
            pass
        other.kill()
    assert str(out) in unfinished_message(out)
    with open_run_folder(out) as run:
        assert [path.name for path in run.stage.iterdir()] == ["README.txt"]
    assert not out.exists() or contents(out) == {}


def test_an_output_that_cannot_be_written_is_found_before_the_first_frame(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file, a name below a file, and a disk with too little room are refused with the name before any frame is read;
    oracle: no frame is tracked.
    """
    monkeypatch.setattr("vggtgeo.slam.run.step", lambda *_: pytest.fail("a frame was tracked"))
    (tmp_path / "file").write_text("")
    for name in ("file", "file/run"):
        done = call(frames, tmp_path / name)
        assert done.exit_code == 2
        assert f"{tmp_path / 'file'}" in done.stderr

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    done = call(frames, tmp_path / "out")
    assert done.exit_code == 2
    assert (
        f"`{tmp_path / 'out'}` cannot be written: No space left on device; a run needs {RESERVE >> 20} MB"
        in done.stderr
    )
    assert not (tmp_path / "out").exists()


def test_a_lock_is_held_once(tmp_path: Path) -> None:
    """A second lock is refused until the first is released; only an empty file is removed. Oracle: the file."""
    with locked(tmp_path / "lock"), pytest.raises(LockedError, match="lock"), locked(tmp_path / "lock"):
        pass
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "lock").write_text("content of another program")
    with locked(tmp_path / "lock"):
        pass
    assert (tmp_path / "lock").read_text() == "content of another program"


def test_depth_is_saved_where_there_is_any_with_its_unit(tmp_path: Path) -> None:
    """Counts are 1/5000 m, what is too far for 16 bits is none, the folder says its unit, and without depth there is no
    folder but a warning; oracle: the depth that was given.
    """
    metres, one = np.array([[1.0, np.nan], [13.2, 0.5]], np.float32), np.ones((2, 2), np.float32)
    depth = DepthMap(metres, one, one)
    write_depth(tmp_path, [(7, depth), (8, None)], metric=False)
    assert sorted(path.name for path in (tmp_path / "depth").iterdir()) == [
        "000007.confidence.png",
        "000007.depth.png",
        "README.txt",
    ]
    found = cv2.imread(str(tmp_path / "depth/000007.depth.png"), cv2.IMREAD_UNCHANGED)
    assert found.tolist() == [[5000, 0], [0, 2500]]
    assert "scale of this run is unknown" in (tmp_path / "depth/README.txt").read_text()
    with warns("depth"):
        write_depth(tmp_path / "none", [(7, None)])
    assert not (tmp_path / "none").exists()
