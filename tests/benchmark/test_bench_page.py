"""The page of a batch and its drawings: everything in one file, nothing loaded from elsewhere."""

from pathlib import Path

import numpy as np
import tiny_suites as tiny
from bench_rows import EXTERNAL, ROWS, row
from checked_page import CheckedPage

from vggtgeo.benchmark.figures import paths
from vggtgeo.benchmark.page import write_page
from vggtgeo.geometry.trajectory import Trajectory


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
