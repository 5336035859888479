"""From rows to tables: statistics, Markdown, CSV, Parquet, the page, other systems' trajectories and figures."""

import csv
import io
import os
import runpy
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import tiny_suites as tiny
from conftest import ROOT
from scipy.stats import ttest_rel
from typer.testing import CliRunner

from vggtgeo.benchmark import cells, markdown, runner
from vggtgeo.benchmark.external import external_rows, tell_missing
from vggtgeo.benchmark.figures import ablation_figure, cost_figure, paths
from vggtgeo.benchmark.measure import between, trajectory_errors
from vggtgeo.benchmark.page import write_page
from vggtgeo.benchmark.published import published
from vggtgeo.benchmark.runner import BenchReport
from vggtgeo.benchmark.statistics import Summary, paired
from vggtgeo.benchmark.table import as_csv, columns, write_parquet
from vggtgeo.cli.main import make_app
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.locks import locked

EXTERNAL = '\n[[external]]\nname = "other"\ntitle = "Other-SLAM"\nfiles = "other/{sequence}.txt"\n'


def row(sequence: str, setting: str, seed: int, cm: float | None, **more: object) -> dict:
    """A row of the table."""
    known = {"status": "ok", "verdict": "good", "frames": 10, "tracked": 9, "protocol": "every-frame", "metric": True}
    errors = {} if cm is None else {"ate_se3_m": cm / 100, "ate_sim3_m": cm / 200, "scale": 1.0}
    return {"suite": "tiny", "sequence": sequence, "setting": setting, "seed": seed, **known, **errors, **more}


ROWS = [
    *(row("walk", "full", seed, cm) for seed, cm in enumerate((2.0, 4.0, 3.0))),
    *(row("walk", "bare", seed, cm) for seed, cm in enumerate((5.0, 9.0, 7.0))),
    *(row("hall", "full", seed, cm) for seed, cm in enumerate((8.0, 8.5, 9.0))),
    *(row("hall", "bare", seed, cm) for seed, cm in enumerate((7.0, 8.0, 7.5))),
]


def test_summaries_are_those_of_the_textbook() -> None:
    # Proves mean, deviation and interval, that NaN is left out, and that one number has no interval. Oracle: scipy's
    # paired t-test, whose interval is that of the mean difference.
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 12))
    found = Summary.of(np.append(a - b, np.nan))
    low, high = ttest_rel(a, b).confidence_interval(0.95)
    np.testing.assert_allclose([found.mean - found.half, found.mean + found.half], [low, high], rtol=1e-12)
    assert (found.count, found.deviation) == (12, pytest.approx(np.std(a - b, ddof=1)))
    assert found.differs == (low > 0 or high < 0)
    assert not Summary.of(np.full(3, 0.1)).differs
    assert not Summary.of(np.zeros(3)).differs
    one = Summary.of(np.array([5.0]))
    assert (one.mean, np.isnan(one.half), one.differs) == (5.0, True, False)
    assert cells.number_cell(one, 2) == "5.00"


def test_differences_are_taken_run_by_run() -> None:
    # Proves that pairs are of one sequence and seed, and that a run without partner is left out. Oracle: by hand.
    rows = [row("walk", "full", 1, 4.0), row("walk", "bare", 0, 5.0), row("walk", "bare", 1, 9.0), *ROWS[6:]]
    np.testing.assert_allclose(100 * paired(rows, "bare", "full", "ate_se3_m", "walk"), [5.0])
    np.testing.assert_allclose(100 * paired(rows, "bare", "full", "ate_se3_m"), [-1.0, -0.5, -1.5, 5.0])
    # Over all sequences a recording is one sample, and a rendered world one for each seed.
    found = paired(rows, "bare", "full", "ate_se3_m", recorded={"hall"})
    np.testing.assert_allclose(100 * found, [-1.0, 5.0])
    np.testing.assert_allclose(paired([*ROWS[:3], row("walk", "bare", 0, None)], "bare", "full", "ate_se3_m"), [])


def test_seeds_of_a_recording_are_no_recordings() -> None:
    # Proves that the row over all sequences counts a recording once, and that seeds which agree mark nothing.
    rows = [row(name, "full", seed, 1.0) for name in ("walk", "hall") for seed in range(5)]
    rows += [row("walk", "bare", seed, 1.8 + 0.01 * seed) for seed in range(5)]
    rows += [row("hall", "bare", seed, 1.2) for seed in range(5)]
    suite = tiny.suite()
    recorded = replace(suite, sequence=tuple(replace(one, simulate={}, path=one.name) for one in suite.sequence))
    found = {one.sequence: one for one in cells.differences(recorded, rows)}
    assert {name: one.pairs for name, one in found.items()} == {"walk": 5, "hall": 5, "all": 2}
    assert {name: one.cells[0].place for name, one in found.items()} == {"walk": 2, "hall": 0, "all": 0}


def test_yaw_is_about_the_vertical_of_the_truth() -> None:
    # Proves the axis of a world with y up. Oracle: a path that was turned about y, and moved.
    angle, times = np.radians(40.0), np.arange(20.0)
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(20, 3))
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    turn[:3, 3] = 1.0, 2.0, 3.0
    estimate, truth = Trajectory(times, turn @ poses), Trajectory(times, poses)
    assert trajectory_errors(estimate, truth, vertical="y")[0]["ate_yaw_m"] == pytest.approx(0.0, abs=1e-9)
    assert trajectory_errors(estimate, truth)[0]["ate_yaw_m"] > 0.5


def test_tables_mark_the_best_and_the_second() -> None:
    # Proves the numbers of the tables and their marks, and that a bar in a title does not break a row. Oracle: by hand.
    text = markdown.page(tiny.suite(), ROWS)
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
        text, page = markdown.page(tiny.suite(), suite_rows), (tmp_path / "report.html").read_text()
        for group in ("Depth", "Map, scores within 5 cm", "Cost"):
            assert (f"### {group}" in text) == (f"<h3>{group}</h3>" in page) == there, group
        for number in shown:
            assert (f" {number} |" in text) == (f">{number}</span>" in page) == there, number
    lines = markdown.page(tiny.suite(), rows).partition("### Map")[2].partition("###")[0]
    assert "| walk |" in lines
    assert "| hall |" not in lines, "a sequence without a true surface has an empty line"


def test_the_tables_of_the_documents_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that `docs/write_tables.py --clips` puts the numbers of a batch between the marks of the README, and leaves
    # the rest. Oracle: the rows.
    rows = [row("icl-office", "default", 0, 2.0, **EVERYTHING)]
    (tmp_path / "runs.csv").write_text(as_csv(rows))
    (tmp_path / "README.md").write_text("before\n<!-- tables: begin -->\nold\n<!-- tables: end -->\nafter\n")
    write = runpy.run_path(str(ROOT / "docs" / "write_tables.py"))["main"]
    monkeypatch.setitem(write.__globals__, "DOCS", tmp_path / "docs")
    monkeypatch.setattr(sys, "argv", ["write_tables.py", "--clips", str(tmp_path)])
    write()
    text = (tmp_path / "README.md").read_text()
    assert text.startswith("before\n<!-- tables: begin -->\n### Poses\n\n| sequence |")
    assert text.endswith("<!-- tables: end -->\nafter\n")
    assert "| icl-office | RGB-D | 1 | 9/10 | 97.5 | 2.00 |" in text
    assert "old" not in text


def test_medians_stand_beside_means() -> None:
    # Proves that from three seeds on a cell has the median over them, the mean over sequences that of the medians, and
    # from three sequences on a column of its own the median over those. Oracle: by hand, with an outlier.
    suite = tiny.suite(tiny.TEXT.replace("[[setting]]", '[[sequence]]\nname = "extra"\npath = "x"\n\n[[setting]]', 1))
    errors = {"walk": (1.0, 2.0, 9.0), "hall": (3.0, 3.0, 3.0), "extra": (5.0, 6.0, 40.0)}
    rows = [row(name, "full", seed, cm) for name, own in errors.items() for seed, cm in enumerate(own)]
    assert cells.matrix_heads(suite, rows, cells.SE3) == ["walk", "hall", "extra", "mean", "median"]
    ((_, line),) = cells.matrix(suite, rows, cells.SE3)
    assert [one.text for one in line] == ["4.00 ± 4.36", "3.00 ± 0.00", "17.00 ± 19.92", "8.00", "4.00"]
    assert [one.median for one in line] == ["2.00", "3.00", "6.00", "3.67", ""]
    assert "standard deviation over seeds / median." in markdown.page(suite, rows)
    assert "/" not in markdown.accuracy(suite, [one for one in rows if one["seed"] < 2], cells.SE3)


def test_a_mean_is_over_the_sequences_that_all_have() -> None:
    # Proves that a system that is missing on a hard sequence gets no better mean by it. Oracle: by hand.
    rows = [one for one in ROWS if (one["sequence"], one["setting"]) != ("hall", "bare")]
    rows += [row("extra", "full", 0, 1.0), row("extra", "bare", 0, 3.0)]
    suite = tiny.suite(tiny.TEXT.replace("[[setting]]", '[[sequence]]\nname = "extra"\npath = "x"\n\n[[setting]]', 1))
    assert cells.matrix_heads(suite, rows, cells.SE3) == ["walk", "hall", "extra", "mean of 2"]
    lines = dict(cells.matrix(suite, rows, cells.SE3))
    assert [one.text for one in lines["without | lines"]] == ["7.00 ± 2.00", "", "3.00", "5.00"]


def test_a_free_scale_has_no_error_at_true_scale() -> None:
    # Proves that runs without a scale are called free after SE(3), in the table and in the differences, and are
    # compared after Sim(3). Oracle: by hand.
    rows = [*ROWS[:3], *({**one, "metric": False} for one in ROWS[3:6])]
    text = markdown.page(tiny.suite(), rows)
    assert "| without \\| lines | free |" in text
    assert "| without \\| lines | walk | 3 |  | **+2.00 ± 1.24** |" in text
    assert "| walk | without \\| lines | 3 | 27/30 | free | 3.50 ± 1.00 / 3.50 |" in text


def test_what_has_no_result_is_told() -> None:
    # Proves that crashes and recordings that are not there are in the page, and in no mean.
    rows = [*ROWS[:2], row("walk", "full", 2, None, status="crash", message="ended by SIGSEGV")]
    rows.append(row("hall", "full", 0, None, status="absent"))
    text = markdown.page(tiny.suite(), rows)
    assert "| walk | full | 2 | crash | ended by SIGSEGV |" in text
    assert "Not there: hall" in text
    assert "## Provenance" not in text, "an empty table"
    assert "## Provenance" in markdown.page(tiny.suite(), [row("walk", "full", 0, 2.0, version="0.1.0")])
    assert "| full system | 3.00 ± 1.41 (2 of 3) |" in text
    assert "| walk | full system | 2 of 3 | 27/30 |" in text
    assert "# a b\n" in markdown.page(replace(tiny.suite(), title="a\nb"), rows)


def test_a_setting_that_loses_runs_is_not_the_best_by_that() -> None:
    # Proves that a mean over the runs that came through is called so, is not compared with means over all, and that a
    # setting of which no run came through says how they ended. Oracle: by hand; 2.0 would be the best.
    lost = [row("walk", "bare", seed, None, status="timeout") for seed in (1, 2)]
    rows = [*ROWS[:3], row("walk", "bare", 0, 2.0), *lost, row("walk", "other", 0, 5.0, external="a.txt")]
    rows += [
        *ROWS[6:9],
        row("hall", "bare", 0, None, verdict="failed"),
        row("hall", "bare", 1, None, status="crash", verdict=None),
    ]
    suite = tiny.suite(tiny.TEXT + EXTERNAL)
    lines = dict(cells.matrix(suite, rows, cells.SE3))
    assert lines["without | lines"] == [cells.Cell("2.00 (1 of 3)"), cells.Cell("1 failed, 1 crash")]
    assert lines["full system"][0] == cells.Cell("3.00 ± 1.00", 1, "3.00")
    assert lines["Other-SLAM"][0] == cells.Cell("5.00", 2)
    assert cells.matrix_heads(suite, rows, cells.SE3) == ["walk", "hall"]


def test_labels_of_any_length_leave_room_for_the_drawing() -> None:
    # Proves that long titles break, and short ones do not: axes that collapse are a warning of Matplotlib, which is an
    # error here. Oracle: the lines of the labels.
    text = tiny.TEXT.replace("full system", "the whole of the system with everything that it has, and " * 4)
    rows = [{**one, "seconds_tracking": 2.0, "peak_memory_gb": 0.5} for one in ROWS]
    figure = ablation_figure(tiny.suite(text), rows)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert labels[0].count("\n") == 2
    assert labels[0].endswith(" ...")
    assert labels[1] == "without | lines"
    for drawn in (figure, cost_figure(tiny.suite(text), rows)):
        drawn.canvas.draw()


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


def test_names_that_are_no_utf8_stand_in_every_table(tmp_path: Path) -> None:
    # Proves that the name of a folder in a message does not end a batch whose runs are all done. Oracle: the texts.
    parquet = pytest.importorskip("pyarrow.parquet", reason="PyArrow is not installed")
    name = os.fsdecode(b"d" + bytes([255]))
    failed = row("walk", "full", 0, None, status="error", message=f"no `x` in `{name}`")
    folder = tmp_path / name
    BenchReport(tiny.suite(), (failed,), folder).write(folder)
    (folder / "runs.parquet").rename(tmp_path / "runs.parquet")
    assert parquet.read_table(tmp_path / "runs.parquet").to_pylist()[0]["message"] == "no `x` in `d\ufffd`"
    for name in ("runs.csv", "tables.md", "report.html"):
        assert "no `x` in `d" in (folder / name).read_text(encoding="utf-8", errors="replace"), name


def test_other_systems_are_rows_of_their_own(tmp_path: Path) -> None:
    # Proves that a trajectory of another system is measured against the truth of the suite's run, after both
    # alignments, and that a file that is no trajectory is a row that says so. Oracle: a scaled truth: SE(3) sees it.
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(40, 3)).cumsum(axis=0)
    truth = Trajectory(np.arange(40) / 10, poses)
    scaled = poses.copy()
    scaled[:, :3, 3] *= 1.25
    truth.save_tum(tmp_path / "out/runs/walk.full.0/truth.txt")
    Trajectory(truth.timestamps, scaled).save_tum(tmp_path / "other/walk.txt")
    suite = tiny.suite(tiny.TEXT + EXTERNAL)
    (found,) = external_rows(suite, tiny.jobs(), tmp_path / "out/runs", tmp_path)
    assert (found["setting"], found["sequence"], found["status"]) == ("other", "walk", "ok")
    assert found["ate_sim3_m"] == pytest.approx(0.0, abs=1e-9)
    assert found["scale"] == pytest.approx(0.8)
    assert found["ate_se3_m"] > 0.1
    assert found["rte_1s_m"] > 0.1
    assert len(found["input_hash"]) == 16
    (free,) = external_rows(
        tiny.suite(tiny.TEXT + EXTERNAL + "metric = false\n"), tiny.jobs(), tmp_path / "out/runs", tmp_path
    )
    assert free["rte_1s_m"] == pytest.approx(0.0, abs=1e-9)
    (tmp_path / "other/walk.txt").write_text("nothing")
    (broken,) = external_rows(suite, tiny.jobs(), tmp_path / "out/runs", tmp_path)
    assert broken["status"] == "error"


def test_a_system_without_any_file_is_told_before_the_runs(tmp_path: Path) -> None:
    # Proves that a misspelt place of other systems' trajectories is a warning, and one file is enough for none. Oracle:
    # that nothing is said where it is there (warnings are errors here).
    suite = tiny.suite(tiny.TEXT + EXTERNAL)
    with pytest.warns(
        InputWarning, match=r"no trajectory of `other` is there: no `.*other/walk.txt`, nor any other of 2"
    ):
        tell_missing(suite, tiny.jobs(), tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/hall.txt").touch()
    tell_missing(suite, tiny.jobs(), tmp_path)


def test_relative_errors_of_a_free_scale_are_taken_after_it() -> None:
    # Proves that RTE of an estimate without scale is that after the Sim(3) alignment. Oracle: a scaled truth has none.
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(60, 3)).cumsum(axis=0)
    scaled = poses.copy()
    scaled[:, :3, 3] *= 4
    times = np.arange(60) / 10
    free, _ = trajectory_errors(Trajectory(times, scaled), Trajectory(times, poses), metric=False)
    metric, _ = trajectory_errors(Trajectory(times, scaled), Trajectory(times, poses), metric=True)
    assert free["rte_1s_m"] == pytest.approx(0.0, abs=1e-9)
    assert metric["rte_1s_m"] > 1.0
    assert "scale is 0.25" in metric["warnings"]
    assert trajectory_errors(Trajectory(times[:2], poses[:2]), Trajectory(times, poses))[0]["matched"] == 0


def test_the_truth_is_that_of_the_frames_that_were_read() -> None:
    # Proves that a run on a part of a recording is not told that it misses the rest. Oracle: by hand.
    truth = Trajectory(np.arange(100) / 10, np.tile(np.eye(4), (100, 1, 1)))
    part = between(truth, 2.0, 4.0)
    assert (part.timestamps[0], part.timestamps[-1]) == (2.0, 4.0)
    assert len(between(truth, 50.0, 60.0)) == 100


def test_published_figures_have_source_and_protocol_and_stand_apart() -> None:
    # Proves that figures of others are never in a table of own ones. Oracle: the section they are in.
    table = published("tum-freiburg1")
    assert table.source
    assert table.protocol
    assert table.rows["ORB-SLAM3"][0] == "lost"
    text = markdown.page(tiny.suite(tiny.TEXT.replace("seeds = 3", 'seeds = 3\npublished = ["tum-freiburg1"]')), ROWS)
    before, _, after = text.partition("## Published by others")
    assert "DROID-SLAM" not in before
    assert "| DROID-SLAM (uncalibrated)* | 0.202 |" in after
    assert "Not measured here" in after
    lost = (
        "| ORB-SLAM3 | lost | 0.017 | 0.210 | lost | 0.034 | lost | lost | lost | 0.009 | C. Campos et al., ORB-SLAM3: "
    )
    assert lost in after
    assert "`-`" not in after
    other = markdown.published_table(published("averages"))
    assert "| SLAM3R* | - | 0.066 | Y. Liu et al., SLAM3R" in other
    assert "`-`: not published." in other
    with pytest.raises(InputError, match="there is no published table `x`"):
        published("x")


class _Page(HTMLParser):
    """Counts elements, and notes what the page would load."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attributes: list) -> None:
        values = dict(attributes)
        if tag not in ("meta", "link", "br", "img"):
            self.open.append(tag)
        self.loaded += [values[name] for name in ("src",) if values.get(name)]
        self.links += [values["href"]] if tag == "a" else []

    def handle_startendtag(self, tag: str, attributes: list) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


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
    page = _Page()
    page.feed(text)
    assert page.open == []
    assert page.loaded == []
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


def test_a_suite_without_any_result_has_a_page(tmp_path: Path) -> None:
    # Proves that a batch in which everything failed can be looked at, and drawn.
    rows = [row("walk", "full", 0, None, status="crash", message="x")]
    write_page(tmp_path / "report.html", tiny.suite(), rows, tmp_path)
    assert "crash" in (tmp_path / "report.html").read_text()
    assert markdown.page(tiny.suite(), rows)
    assert ablation_figure(tiny.suite(), rows) is not None


def test_the_tables_say_what_makes_a_row_doubtful() -> None:
    """A scale that cannot be stands in the tables, not only in `runs.csv`; rows that are no runs are not called so."""
    good = row("walk", "full", 0, 0.01, warnings="the scale is 7")
    gone = row("hall", "full", 0, None, status="absent")
    other = row("walk", "other", 0, 0.02, external="a.txt")
    text = markdown.page(tiny.suite(), [good, gone, other])
    assert "## Warnings" in text
    assert "| walk | full | 0 | the scale is 7 |" in text
    assert "1 run, 1 more whose recording is not there, 1 of other systems." in text
    assert "## Warnings" not in markdown.page(tiny.suite(), ROWS)


def test_the_report_of_a_batch(tmp_path: Path) -> None:
    # Proves what `vggtgeo.bench` hands back, and its files.
    report = BenchReport(tiny.suite(), tuple(ROWS), tmp_path)
    report.write(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} >= {"report.html", "tables.md", "runs.csv"}
    assert (tmp_path / "tables.md").read_text() == report.markdown()
    assert report.to_dict()["rows"][0]["sequence"] == "walk"
    assert "12 of 12 runs" in repr(report)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nosuch",), "`nosuch` is no suite and no TOML file; suites that come along: 7scenes"),
        (("quick", "--sequences", "attic"), "`sequences` holds ['attic']; choose among office"),
        (("quick", "--settings", ","), "`settings` holds nothing"),
        (("quick", "--data", "/no/such/place"), "`data` is `/no/such/place`, which is no folder"),
        (("quick", "--timeout-minutes", "0"), "`timeout_minutes` is 0.0; it must be positive"),
        (("quick", "--memory-gb", "-1"), "`memory_gb` is -1.0; it must be positive"),
        (("quick", "--first-seed", "9999999999"), "seeds go to 9999999999; the last that may be is"),
        (("quick", "-o", "/proc/nowhere"), "`/proc/nowhere` cannot be written"),
    ],
)
def test_a_wrong_argument_is_one_line(arguments: tuple[str, ...], message: str, tmp_path: Path) -> None:
    # Proves that a wrong name ends before any work, with what can be chosen.
    outcome = CliRunner().invoke(make_app(), ["bench", "-o", str(tmp_path / "out"), *arguments])
    assert outcome.exit_code == 2
    assert message in outcome.stderr
    assert not (tmp_path / "out").exists()


def test_the_command_runs_a_suite_and_prints_its_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves the command from the file to the tables, with a stand-in for the runs. Oracle: the text of the report, and
    # the errors of the stand-in.
    plain = runner.all_rows
    monkeypatch.setattr(runner, "all_rows", lambda *given: plain(*given, command=tiny.worker()))
    (tmp_path / "tiny.toml").write_text(tiny.TEXT)
    arguments = ["bench", str(tmp_path / "tiny.toml"), "-o", str(tmp_path / "out"), "--seeds", "1", "--workers", "2"]
    outcome = CliRunner().invoke(make_app(), arguments)
    assert outcome.exit_code == 0, outcome.output
    assert outcome.stdout.strip() == (tmp_path / "out/tables.md").read_text().strip()
    assert "walk, bare, seed 0: ATE 2.40 cm after SE(3), 4/4 frames, good (simulated)" in outcome.stderr
    assert "| full system | **1.40** | **1.40** | **1.40** |" in outcome.stdout
    listed = CliRunner().invoke(make_app(), ["bench", "list"])
    assert "The paper's tables, simulated" in listed.stdout


def test_a_batch_in_which_nothing_has_a_result_ends_with_1(tmp_path: Path) -> None:
    """As where no recording is there: a script must not take it for a success."""
    (tmp_path / "none.toml").write_text(
        'title = "t"\n[[sequence]]\nname = "a"\npath = "nowhere"\n[[setting]]\nname = "full"\n'
    )
    (tmp_path / "data").mkdir()
    arguments = ["bench", str(tmp_path / "none.toml"), "-o", str(tmp_path / "out"), "--data", str(tmp_path / "data")]
    outcome = CliRunner().invoke(make_app(), arguments)
    assert outcome.exit_code == 1, outcome.output
    assert "Not there: a" in outcome.stdout


def test_two_batches_keep_off_each_other(tmp_path: Path) -> None:
    # Proves that a folder that a batch writes into is refused to a second, which would take its runs away, and is free
    # after it. Oracle: the lock, held here.
    suite = tiny.suite(tiny.TEXT.replace('simulate = { scene = "room", frames = 4 }', 'path = "gone"'))
    part = {"sequences": ["walk"], "data": [tmp_path]}
    (tmp_path / "out").mkdir()
    with (
        locked(tmp_path / "out" / ".bench.lock"),
        pytest.raises(InputError, match=r"in use by another batch \(process"),
    ):
        runner.bench(suite, tmp_path / "out", **part)
    assert not (tmp_path / "out" / "runs.csv").exists()
    report = runner.bench(suite, tmp_path / "out", **part)
    assert [row["status"] for row in report.rows] == ["absent"] * 6
    assert not (tmp_path / "out" / ".bench.lock").exists()


def test_an_output_that_is_a_file_is_refused(tmp_path: Path) -> None:
    # Proves that nothing is run whose result could not be written.
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        runner.bench("quick", tmp_path / "file")


@pytest.mark.slow  # compiles; notebooks/evaluate.ipynb runs the same path
def test_two_real_runs_from_start_to_tables(tmp_path: Path) -> None:
    # Proves that worker, stubs, pipeline and metrics fit together. Oracle: a run without lines gives other numbers; a
    # trajectory within 5 cm; depth and map compared with the exact ones.
    report = runner.bench("paper-small", tmp_path, sequences=["room"], settings=["full", "C"], seeds=1)
    assert [row["status"] for row in report.rows] == ["ok", "ok"], report.rows
    assert all(0 < row["ate_se3_m"] < 0.05 for row in report.rows)
    assert report.rows[0]["ate_se3_m"] != report.rows[1]["ate_se3_m"]
    assert all(0 < row["depth_rmse_m"] < row["depth_prior_rmse_m"] < 1 for row in report.rows)
    assert all(0.3 < row["f_score"] <= 1 for row in report.rows)
    assert report.rows[0]["simulated"] is True
