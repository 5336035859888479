"""Invalid inputs: how each ends, and what the message names.

Each row of `tests/helpers/bad_rows.py` makes its input and gives it to the command line, or to the reader that the
command line calls. Oracle: the row. An error ends the program with code 2 and one line, in less than 500 MB.
After a warning the rest is used.
"""

from __future__ import annotations

import resource
import warnings
from pathlib import Path

import pytest
from bad_rows import ROWS, Row
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.io.errors import InputError, InputWarning

pytestmark = pytest.mark.usefixtures("uncompiled")
MEGABYTES = 500


def errors_of(row: Row, folder: Path) -> list[str]:
    """Return the errors of a row: those of the command line, or that of the call."""
    made = row.make(folder)
    if row.call is not None:
        try:
            row.call(made)
        except InputError as error:
            return [str(error)]
        return []
    assert row.argv is not None
    done = CliRunner().invoke(make_app(), list(map(str, row.argv(made))), prog_name="vggtgeo")
    lines = done.stderr.splitlines()
    assert done.exit_code == 2, done.output
    assert len(lines) == 1, done.stderr
    return lines


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.kind}: {row.given}".replace(" ", "-"))
def test_invalid_inputs(row: Row, tmp_path: Path) -> None:
    """An invalid input ends as its row says, names what is invalid, and takes little memory; oracle: the row."""
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        errors = errors_of(row, tmp_path)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
    warned = [str(entry.message) for entry in caught if issubclass(entry.category, InputWarning)]
    assert bool(errors) != row.warned, (errors, warned)
    found = [" ".join(message.split()) for message in (warned if row.warned else errors)]
    assert any(all(name in message for name in row.named) for message in found), (row.named, found)
    assert grown < MEGABYTES * 2**10
