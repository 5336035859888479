"""The table of bad inputs: what a user may give, and what the user sees.

Each row makes its input and gives it to the command line, or to the reader that the command line calls. Oracle: the
page `docs/bad-inputs.md`: how the row ends, and what the message names first (an argument or a file, not its words).

What is an error ends with code 2 and one line, with the name of what is wrong, within a second and 500 MB. What is a
warning is told and the rest goes on. What is used is used without a word, because nothing is lost.
"""

from __future__ import annotations

import json
import re
import resource
import subprocess
import sys
import time
import warnings
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

PAGE = (ROOT / "docs" / "bad-inputs.md").read_text(encoding="utf-8")
pytestmark = pytest.mark.usefixtures("uncompiled")
SECONDS = 1.0
MEGABYTES = 500


def seen(row: Row, made: Any) -> tuple[str, list[str]]:
    """How the row ends ("error", or "used" where nothing is refused), and what is said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if row.argv is None:
                row.call(made)
                end, said = "used", []
            else:
                given = list(map(str, row.argv(made)))
                done = CliRunner().invoke(make_app(), given, prog_name="vggtgeo")
                assert done.exit_code in (0, 2, 3), done.output
                end = "error" if done.exit_code == 2 else "used"
                said = [line.removeprefix("error: ") for line in done.stderr.splitlines() if line.startswith("error: ")]
                assert end == "used" or len(done.stderr.splitlines()) - len(said) <= 0, done.stderr
        except InputError as error:
            end, said = "error", [str(error)]
    told = [str(entry.message) for entry in caught if issubclass(entry.category, InputWarning)]
    return end, said + told


def page_rows() -> dict[tuple[str, str], tuple[str, str]]:
    """How each row of the page ends and what is seen, by its group and what is given."""
    found = {}
    for part in PAGE.split("\n## ")[1:]:
        group, *lines = part.splitlines()
        for line in lines:
            cells = [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            if len(cells) == 3 and cells[1] in ("error", "warning", "used"):
                found[group, cells[0]] = cells[1], cells[2]
    return found


TABLE = page_rows()


def named(sentence: str) -> str:
    """What the table's sentence names first, in backticks or quotes: the argument, or the file; `...` is anything."""
    first = re.search(r"`([^`]*)`|'([^']*)'", sentence)
    text = sentence if first is None else first[1] or first[2]
    return ".*".join(re.escape(part) for part in text.split("..."))


@cache
def seen_by_a_script() -> dict[str, tuple[str, list[str], float]]:
    """What every call of `bad_rows_python.py` came to, in a process without the checks of these tests."""
    done = subprocess.run([sys.executable, bad_rows_python.__file__], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-1000:]
    told: dict[str, tuple[str, list[str], float]] = json.loads(done.stdout)
    return told


@pytest.mark.parametrize("row", PYTHON, ids=lambda row: row.given.replace(" ", "-"))
def test_what_a_script_sees(row: Row) -> None:
    """The page's sentence for a call of the library, and the way it ends; oracle: the page."""
    ends, sees = TABLE[row.group, row.given]
    end, said, seconds = seen_by_a_script()[row.given]
    assert end == ("error" if ends == "error" else "used"), said
    assert any(re.search(named(sees), " ".join(line.split())) for line in said) if sees else said == [], said
    assert seconds < SECONDS * row.slack, f"{seconds:.2f} s"


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.group}: {row.given}".replace(" ", "-"))
def test_what_the_user_sees(row: Row, tmp_path: Path) -> None:
    """The page's sentence for the row, and the way it ends."""
    ends, sees = TABLE[row.group, row.given]
    made = row.make(tmp_path)
    before, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    end, said = seen(row, made)
    seconds, grown = time.process_time() - before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
    assert end == ("error" if ends == "error" else "used"), said
    if ends == "used":
        assert said == []
    else:
        assert any(re.search(named(sees), " ".join(line.split())) for line in said), said
    assert grown < MEGABYTES * 2**10
    if ends == "error":
        assert seconds < SECONDS * row.slack, f"{seconds:.2f} s"


def test_the_page_has_every_row_and_no_other() -> None:
    """Page and rows are of the same inputs, at least 120 of them, each told in a sentence of its own."""
    rows = [(row.group, row.given) for row in (*ROWS, *PYTHON)]
    assert [row for row in rows if row not in TABLE] == []
    assert set(TABLE) == set(rows)
    assert len(rows) == len(TABLE) >= 120
    assert [given for given, (ends, sees) in TABLE.items() if (ends == "used") != (not sees)] == []
