"""A small address space (`ulimit -v`), a working folder that is gone. Oracle: one line and code 2."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from vggtgeo.cli.environment import MIN_GB, check_address_space
from vggtgeo.cli.main import COMMANDS


def limited(megabytes: int, *words: object) -> subprocess.CompletedProcess[str]:
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({megabytes * 10**6},) * 2)"
    command = [sys.executable, "-c", f"{limit}; from vggtgeo.cli import main; main()", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_a_command_that_would_be_aborted_does_not_begin(tmp_path: Path) -> None:
    """The limit and the need, in one line; nothing is made. Help needs no memory."""
    done = limited(1500, "demo", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr == (
        "error: the address space is limited to 1.5 GB (`ulimit -v`); `demo` needs at least 3 GB: raise or remove "
        "the limit\n"
    )
    assert list(tmp_path.iterdir()) == []
    assert limited(700, "run", "--help").returncode == 0
    assert limited(700, "data", "list").returncode == 0


def test_each_command_of_the_table_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """And without a limit nothing is asked of any."""
    assert set(MIN_GB) <= {entry.name for entry in COMMANDS}
    monkeypatch.setattr("resource.getrlimit", lambda kind: (resource.RLIM_INFINITY,) * 2)
    for entry in COMMANDS:
        check_address_space(entry.name)
