"""Standard output and error that cannot be written. Oracle: the exit code, the lines on stderr, the run's files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import bad_files as bad
import pytest

FULL = Path("/dev/full")
PROGRAM = (sys.executable, "-c", "from vggtgeo.cli import main; main()")
LOST = "error: standard output cannot be written (No space left on device): printed text is lost, files are"
pytestmark = pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")


def called(*words: object, unbuffered: bool = False, **streams: object) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    environment |= {"PYTHONUNBUFFERED": "1"} if unbuffered else {}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    command = [*PROGRAM, *map(str, words)]
    return subprocess.run(command, text=True, env=environment, timeout=120, check=False, **streams)


@pytest.mark.parametrize("unbuffered", [False, True])
@pytest.mark.parametrize("words", [("--version",), ("--help",), ("data", "list")], ids=" ".join)
def test_what_cannot_be_printed_is_told(words: tuple[str, ...], unbuffered: bool) -> None:
    """One line and the code of what is given wrongly; no traceback, nor a second line when Python ends."""
    with FULL.open("w") as full:
        done = called(*words, unbuffered=unbuffered, stdout=full)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith(LOST)


@pytest.mark.long
@pytest.mark.parametrize("stream", ["stdout", pytest.param("stderr", marks=pytest.mark.slow)])
def test_a_run_that_cannot_print_is_written_as_a_whole(
    tmp_path: Path, stream: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its verdict is failed, which its code says; all its files are there, though another program's `MPLBACKEND`, which
    matplotlib does not know, stands in the environment: that was asked for when the results were written.
    """
    bad.frames(tmp_path / "frames")
    monkeypatch.setenv("MPLBACKEND", "nonsense")
    with FULL.open("w") as full:
        done = called("run", tmp_path / "frames", "-o", tmp_path / "out", **{stream: full})
    assert done.returncode == 3
    assert {"summary.json", "trajectory.txt", "report.html"} <= {file.name for file in (tmp_path / "out").iterdir()}
    if stream == "stdout":
        assert done.stderr.splitlines()[-1].startswith(LOST)
    else:
        assert done.stdout.splitlines()[-1] == "verdict: failed"


@pytest.mark.parametrize("columns", ["0", "1", "-5", "many"])
def test_a_terminal_without_columns_still_shows_what_was_found(tmp_path: Path, columns: str) -> None:
    """`COLUMNS=0` printed blank lines, and ended as if all were well. Oracle: words and numbers of the table."""
    truth = tmp_path / "groundtruth.txt"
    bad.walk(truth, 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", columns)
        done = called("evaluate", truth, truth)
    assert done.returncode == 0, done.stderr
    assert "60 poses" in " ".join(done.stdout.split())
    assert done.stdout.count("0.000") > 4, done.stdout


def test_a_reader_that_went_away_is_no_error() -> None:
    """`vggtgeo data list | head -1`: nothing is said."""
    reading, writing = os.pipe()
    os.close(reading)
    done = called("data", "list", stdout=writing)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")


def test_the_number_of_a_closed_stream_is_no_results_file() -> None:
    """With 1 and 2 closed, a file that is opened gets another number."""
    script = (
        "import os; os.close(1); os.close(2); from vggtgeo.cli.streams import use_lasting_streams as use; use(); "
        "os._exit(os.open(os.devnull, os.O_RDONLY))"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode > 2
