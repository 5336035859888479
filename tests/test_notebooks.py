"""Every notebook runs from top to bottom, reads well without running, and uses what every user may use."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
LONGEST_CELL = 25


def _cells(path: Path, kind: str) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All code cells run in one namespace, in order, without an error or a warning, and print something."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    for number, cell in enumerate(_cells(path, "code")):
        exec(compile("".join(cell["source"]), f"{path.name}[{number}]", "exec"), namespace)
    plt.close("all")
    assert capsys.readouterr().out, f"`{path.name}` printed nothing"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_reads_well(path: Path) -> None:
    """Cells are short, import nothing private, and their outputs are there, without an error or a machine's paths."""
    for number, cell in enumerate(_cells(path, "code")):
        source = "".join(cell["source"])
        where = f"`{path.name}`, code cell {number}"
        assert len(source.splitlines()) <= LONGEST_CELL, f"{where} is longer than {LONGEST_CELL} lines"
        assert not re.search(r"import _|from [\w.]*\b_\w+|import [\w.]*\._", source), f"{where} imports what is private"
        assert cell["execution_count"] == number + 1, f"{where} was not run in order"
        assert all(output["output_type"] != "error" for output in cell["outputs"]), where
        assert "stderr" not in {output.get("name") for output in cell["outputs"]}, where
    pictures = [o for cell in _cells(path, "code") for o in cell["outputs"] if "image/png" in o.get("data", {})]
    assert pictures, f"`{path.name}` shows no picture"
    assert not re.search(r"/(home|root|tmp|Users|work)/", path.read_text()), f"`{path.name}` names a machine's folders"
