"""The tables of a batch: Markdown, CSV, Parquet, and its page: one file, nothing loaded from elsewhere."""

import csv
import io
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_suites as tiny
from bench_rows import EXTERNAL, ROWS, row
from checked_page import CheckedPage
from conftest import ROOT

from vggtgeo.benchmark import report
from vggtgeo.benchmark.figures import paths
from vggtgeo.benchmark.report import write_page
from vggtgeo.benchmark.rows import as_csv, columns, write_parquet
from vggtgeo.geometry.trajectory import Trajectory


def test_tables_mark_the_best_and_the_second() -> None:
    # Proves the numbers of the tables and their marks, and that a bar in a title does not break a row. Oracle: by hand.
    text = report.markdown(tiny.suite(), ROWS)
    assert "| full system | **3.00 ± 1.00** / 3.00 | <u>8.50 ± 0.50</u> / 8.50 | **5.75** / 5.75 |" in text
    assert "| without \\| lines | <u>7.00 ± 2.00</u> / 7.00 | **7.50 ± 0.50** / 7.50 | <u>7.25</u> / 7.25 |" in text
    assert "| without \\| lines | walk | 3 | **+4.00 ± 2.48** | **+2.00 ± 1.24** |" in text
    assert "| without \\| lines | hall | 3 | -1.00 ± 1.24 |" in text
    assert (
        "| walk | full system | 3 | 27/30 | 3.00 ± 1.00 / 3.00 | 1.50 ± 0.50 / 1.50 | 1.0000 ± 0.0000 | 3 good |"
        in text
    )


EVERYTHING = {
    "coverage": 0.975, "nees_place": 0.4321, "focal_error": -0.0123, "depth_rmse_m": 0.0345, "depth_abs_rel": 0.0567,
    "depth_below_1_25": 0.987, "f_score": 0.876, "precision": 0.765, "recall": 0.654, "accuracy_m": 0.0543,
    "completeness_m": 0.0432, "mesh_completeness_m": 0.0321, "threshold_m": 0.05, "rte_1m_m": 0.0191,
    "peak_memory_gb": 1.23,
}  # fmt: skip


def test_what_was_measured_is_in_the_tables(tmp_path: Path) -> None:
    # Proves that coverage, depth, map and cost stand in the Markdown and on the page where they were measured, in their
    # units, and that a group without a number has no table. Oracle: the numbers.
    shown = ("97.5", "0.43", "-1.23", "3.45", "5.67", "98.7", "87.6", "76.5", "65.4", "5.43", "4.32", "3.21", "1.91")
    rows = [row("walk", "full", 0, 2.0, **EVERYTHING), row("hall", "full", 0, 3.0, coverage=1.0)]
    for suite_rows, there in ((rows, True), (rows[1:], False)):
        write_page(tmp_path / "report.html", tiny.suite(), suite_rows, tmp_path)
        text, page = report.markdown(tiny.suite(), suite_rows), (tmp_path / "report.html").read_text()
        for group in ("Depth", "Map, scores within 5 cm", "Cost"):
            assert (f"### {group}" in text) == (f"<h3>{group}</h3>" in page) == there, group
        for number in shown:
            assert (f" {number} |" in text) == (f">{number}</span>" in page) == there, number
    lines = report.markdown(tiny.suite(), rows).partition("### Map")[2].partition("###")[0]
    assert "| walk |" in lines
    assert "| hall |" not in lines, "a sequence without a true surface has an empty line"


def test_the_tables_of_the_documents_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that `docs/write_tables.py --clips` puts the numbers of a batch between the marks of the page, and leaves
    # the rest. Oracle: the rows.
    rows = [row("icl-office", "default", 0, 2.0, **EVERYTHING)]
    (tmp_path / "runs.csv").write_text(as_csv(rows))
    (tmp_path / "docs" / "results").mkdir(parents=True)
    page = tmp_path / "docs" / "results" / "clips.md"
    page.write_text("before\n<!-- tables: begin -->\nold\n<!-- tables: end -->\nafter\n")
    write = runpy.run_path(str(ROOT / "docs" / "write_tables.py"))["main"]
    monkeypatch.setitem(write.__globals__, "DOCS", tmp_path / "docs")
    monkeypatch.setattr(sys, "argv", ["write_tables.py", "--clips", str(tmp_path)])
    write()
    text = page.read_text()
    assert text.startswith("before\n<!-- tables: begin -->\n### Poses\n\n| sequence |")
    assert text.endswith("<!-- tables: end -->\nafter\n")
    assert "| icl-office | RGB-D | 1 | 9/10 | 97.5 | 2.00 |" in text
    assert "old" not in text


def test_the_table_comes_back_from_csv_and_parquet(tmp_path: Path) -> None:
    # Proves that every value is in both files, in one order of columns, with nothing for what a run has not. Oracle:
    # the rows.
    parquet = pytest.importorskip("pyarrow.parquet", reason="PyArrow is not installed")
    rows = [*ROWS[:2], row("walk", "full", 2, None, status="crash", message="a, b\nc", f_score=1)]
    back = list(csv.DictReader(io.StringIO(as_csv(rows))))
    write_parquet(tmp_path / "runs.parquet", rows)
    table = parquet.read_table(tmp_path / "runs.parquet").to_pylist()
    assert list(back[0]) == list(table[0]) == columns(rows)
    for given, text, typed in zip(rows, back, table, strict=True):
        for name in columns(rows):
            assert typed[name] == given.get(name)
            assert text[name] == ("" if given.get(name) is None else str(given[name]))


def test_the_tables_say_what_makes_a_row_doubtful() -> None:
    """A scale that cannot be stands in the tables, not only in `runs.csv`; rows that are no runs are not called so."""
    good = row("walk", "full", 0, 0.01, warnings="the scale is 7")
    gone = row("hall", "full", 0, None, status="absent")
    other = row("walk", "other", 0, 0.02, external="a.txt")
    text = report.markdown(tiny.suite(), [good, gone, other])
    assert "## Warnings" in text
    assert "| walk | full | 0 | the scale is 7 |" in text
    assert "1 run, 1 more without a recording, 1 of other systems." in text
    assert "## Warnings" not in report.markdown(tiny.suite(), ROWS)


def test_the_path_that_is_drawn_is_one_that_can_be(tmp_path: Path) -> None:
    # Proves that of a setting whose first seed lost track at once the next seed is drawn. Oracle: the number of errors.
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    path = Trajectory(np.arange(5.0), poses)
    for seed, count in ((0, 1), (1, 5)):
        path.save_tum(tmp_path / f"runs/walk.full.{seed}/truth.txt")
        path.select(slice(count)).save_tum(tmp_path / f"runs/walk.full.{seed}/estimate.txt")
    (drawn,) = paths(tiny.suite(), ROWS[:2], "walk", tmp_path)
    assert len(drawn.errors) == 5


def test_the_page_holds_everything_and_loads_nothing(tmp_path: Path) -> None:
    # Proves that the page is one well-formed file with tables, drawings, verdicts, links to runs that are there, and
    # the text of a message escaped. Oracle: a parser.
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(40, 3)).cumsum(axis=0)
    for name in ("estimate", "truth"):
        Trajectory(np.arange(40) / 10, poses).save_tum(tmp_path / f"runs/walk.full.0/{name}.txt")
    (tmp_path / "runs/walk.full.0/report.html").write_text("")
    crash = row("walk", "bare", 9, None, status="crash", message="<b>bad</b>")
    suite = tiny.suite(tiny.TEXT.replace("seeds = 3", 'seeds = 3\npublished = ["averages"]') + EXTERNAL)
    timed = [{**one, "seconds_tracking": 2.0, "seconds_window": 1.0, "peak_memory_gb": 0.5} for one in ROWS]
    write_page(tmp_path / "report.html", suite, [*timed, crash], tmp_path)
    text = (tmp_path / "report.html").read_text()
    page = CheckedPage(text)
    assert page.open == []
    assert page.wrong == []
    assert "runs/walk.full.0/report.html" in page.links
    assert all((tmp_path / link).is_file() for link in page.links)
    assert "<b>bad</b>" in page.text
    assert "<b>bad" not in text
    assert text.count("<svg") == 3
    for wanted in (
        "3.00 ± 1.00",
        "Against full system",
        "+4.00 ± 2.48",
        "Time and memory",
        "Published by others",
        "0.022",
        "0.030",
        "Z. Teed, J. Deng, DROID-SLAM",
        "crash",
    ):
        assert wanted in page.text, wanted
