"""Every notebook runs from top to bottom, reads well without running, and uses what every user may use."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from vggtgeo.simulation import simulate
from vggtgeo.simulation.sequence import write_tum_folder

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
LONGEST_CELL = 25
WINDOW = "size=6, point_slots=160, line_slots=64)"
SMALL_WINDOW = (
    "size=4, point_slots=96, line_slots=48), refinement=vg.settings.GlobalMapSettings(global_adjustment=False)"
)
QUICK = ("solve",)
MARKS = {True: pytest.mark.long, False: pytest.mark.slow}
# What the shorter run replaces in the long ones: fewer frames, smaller windows, fewer runs and steps.
SHORTER: dict[str, dict[str, str]] = {
    "own_video": {"frames=45": "frames=16", WINDOW: SMALL_WINDOW},
    "evaluate": {'sequences=["room"]': 'sequences=["room"], seeds=1'},
    "differentiate": {
        "tracked_windows(sequence, 8,": "tracked_windows(sequence, 3,",
        "stacked(range(24)), stacked(range(100, 124))": "stacked(range(3)), stacked(range(100, 103))",
        "range(80)": "range(2)",
    },
}


def _cells(path: Path, kind: str) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


def _run(path: Path, changes: dict[str, str]) -> None:
    """All code cells in one namespace, in order, each text of `changes` replaced."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    unused = set(changes)
    for number, cell in enumerate(_cells(path, "code")):
        source = "".join(cell["source"])
        for text, shorter in changes.items():
            unused -= {text} if text in source else set()
            source = source.replace(text, shorter)
        exec(compile(source, f"{path.name}[{number}]", "exec"), namespace)
    plt.close("all")
    keyframe: Any = namespace.get("keyframe")  # whose panels are drawn
    assert keyframe is None or np.isfinite(keyframe.depth.astype(float)).mean() > 0.5
    assert not unused, f"`{path.name}` no longer holds {unused}"


RUNS = [
    *(pytest.param(path, {}, marks=MARKS[path.stem in QUICK], id=path.stem) for path in NOTEBOOKS),
    *(
        pytest.param(path, SHORTER[path.stem], marks=pytest.mark.slow, id=f"{path.stem} on less data")
        for path in NOTEBOOKS
        if path.stem in SHORTER
    ),
]


@pytest.mark.parametrize(("path", "changes"), RUNS)
def test_notebook_runs(path: Path, changes: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    """Every cell runs, in order, without an error or a warning, and prints something."""
    _run(path, changes)
    assert capsys.readouterr().out, f"`{path.name}` printed nothing"


@pytest.mark.long
def test_solve_starts_from_a_recording_where_there_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The first two cells take a folder in place of the rendered pair, and find how its camera moved; oracle: truth.

    The world is that of the notebook itself, in smaller images: it is built once.
    """
    for _ in write_tum_folder(simulate("office", 10, 3, (320, 240)), tmp_path):
        pass
    namespace: dict[str, Any] = {}
    for cell in _cells(NOTEBOOKS[0].with_name("solve.ipynb"), "code")[:2]:
        source = "".join(cell["source"])
        exec(source.replace('Path("recording")', f"Path({str(tmp_path)!r})"), namespace)
    assert namespace["sequence"].camera.width == 320
    true = np.linalg.inv(namespace["truth"].poses[0]) @ namespace["truth"].poses[9]
    np.testing.assert_allclose(namespace["centre"], true[:3, 3], atol=0.02)
    assert "true [cm]" in capsys.readouterr().out


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
