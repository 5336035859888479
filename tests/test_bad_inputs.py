"""Invalid inputs: how each ends, and what the message names.

Each row makes its input and gives it to the command line, or to the reader that the command line calls. Oracle: the row
of `bad_inputs.csv` of the same reader and input. It holds the kind of fault (wrong, truncated, missing, inconsistent,
or accepted: nothing is lost), the outcome, and what the message must name: the argument or file, and the offending
value. The first row of each reader and kind runs in `make test`, all others are marked `long`.

An error ends the program with code 2 and one line, within a second and 500 MB. After a warning the rest is done. What
is accepted is used without a message.
"""

from __future__ import annotations

import csv
import json
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import bad_rows_python
import pytest
from bad_input_rows import ROWS, Row
from bad_rows_python import PYTHON
from conftest import ROOT
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.io.errors import InputError, InputWarning

pytestmark = pytest.mark.usefixtures("uncompiled")
SECONDS = 1.0
MEGABYTES = 500


@dataclass(frozen=True)
class Expected:
    """kind of the fault; outcome: "error", "warning" or "used"; named: what the message contains."""

    kind: str
    outcome: str
    named: tuple[str, ...]


def expectations() -> dict[tuple[str, str], Expected]:
    """The rows of `bad_inputs.csv` by reader and input."""
    with (ROOT / "tests" / "helpers" / "bad_inputs.csv").open(encoding="utf-8", newline="") as file:
        return {
            (row["reader"], row["input"]): Expected(
                row["kind"], row["outcome"], tuple(filter(None, (row["name"], row["value"])))
            )
            for row in csv.DictReader(file)
        }


TABLE = expectations()
FIRST = {(reader, expected.kind): given for (reader, given), expected in reversed(TABLE.items())}
"""The representative of each reader and kind."""


def is_first(row: Row) -> bool:
    """Whether the row represents its reader and kind of fault."""
    return FIRST[row.group, TABLE[row.group, row.given].kind] == row.given


def parameters(rows: Sequence[Row]) -> list[Any]:
    """The rows as parameters of a test; those that repeat a kind are marked `long`."""
    name = lambda row: f"{row.group}: {TABLE[row.group, row.given].kind}: {row.given}".replace(" ", "-")
    marks = lambda row: () if is_first(row) else pytest.mark.long
    return [pytest.param(row, id=name(row), marks=marks(row)) for row in rows]


def check(expected: Expected, ended: str, messages: list[str]) -> None:
    """Assert that a row ended as expected, and that one message names all that it must."""
    assert ended == ("error" if expected.outcome == "error" else "used"), messages
    if expected.outcome == "used":
        assert messages == []
    else:
        found = [" ".join(message.split()) for message in messages]
        assert any(all(name in message for name in expected.named) for message in found), (expected.named, found)


def result_of(row: Row, made: Any) -> tuple[str, list[str]]:
    """How the row ends ("error" or "used"), and its messages."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if row.argv is None:
                row.call(made)
                ended, messages = "used", []
            else:
                given = list(map(str, row.argv(made)))
                done = CliRunner().invoke(make_app(), given, prog_name="vggtgeo")
                assert done.exit_code in (0, 2, 3), done.output
                ended = "error" if done.exit_code == 2 else "used"
                lines = done.stderr.splitlines()
                messages = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
                assert ended == "used" or len(lines) <= len(messages), done.stderr
        except InputError as error:
            ended, messages = "error", [str(error)]
    return ended, messages + [str(entry.message) for entry in caught if issubclass(entry.category, InputWarning)]


@cache
def results_of_a_script(representatives: bool) -> dict[str, tuple[str, list[str], float]]:
    """The results of the calls of `bad_rows_python.py`, in a process without the checks of these tests."""
    names = [row.given for row in PYTHON if is_first(row) == representatives]
    script = [sys.executable, bad_rows_python.__file__, *names]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-1000:]
    results: dict[str, tuple[str, list[str], float]] = json.loads(done.stdout)
    return results


@pytest.mark.parametrize("row", parameters(PYTHON))
def test_invalid_calls_of_a_script(row: Row) -> None:
    """An invalid call of the library ends as its row says, and names what is invalid; oracle: the table."""
    ended, messages, seconds = results_of_a_script(is_first(row))[row.given]
    check(TABLE[row.group, row.given], ended, messages)
    assert seconds < SECONDS * row.slack, f"{seconds:.2f} s"


@pytest.mark.parametrize("row", parameters(ROWS))
def test_invalid_inputs(row: Row, tmp_path: Path) -> None:
    """An invalid input ends as its row says, names what is invalid, quickly and in little memory; oracle: the table."""
    expected = TABLE[row.group, row.given]
    made = row.make(tmp_path)
    before, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    ended, messages = result_of(row, made)
    seconds, grown = time.process_time() - before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
    check(expected, ended, messages)
    assert grown < MEGABYTES * 2**10
    if expected.outcome == "error":
        assert seconds < SECONDS * row.slack, f"{seconds:.2f} s"


def test_the_table_has_every_row_and_no_other() -> None:
    """Table and rows are of the same inputs, and each row that is not accepted names something."""
    rows = {(row.group, row.given) for row in (*ROWS, *PYTHON)}
    assert set(TABLE) == rows
    assert [key for key, row in TABLE.items() if (row.outcome == "used") != (not row.named)] == []
    assert {row.kind for row in TABLE.values()} == {"wrong", "truncated", "missing", "inconsistent", "accepted"}
