"""The simulated tables of the paper: runs, what is stored of them, and what is made of their numbers."""

import csv
import io
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.io.errors import InputError
from vggtgeo.paper_bench import runner, tables
from vggtgeo.paper_bench.courses import Course
from vggtgeo.paper_bench.measure import Errors
from vggtgeo.paper_bench.plan import PLANS, Group, Job, Plan
from vggtgeo.paper_bench.runner import BenchReport, bench
from vggtgeo.paper_bench.store import BenchRun, Store, fingerprint
from vggtgeo.paper_bench.variants import VARIANTS

TINY = Plan("tiny", (Group(Course("room", 10, 10.0, (96, 72), key_points=200), ("full", "C"), 1),))
ERRORS = Errors(0.01, 0.008, 0.02, 0.3, 0.05, 0.20, 1.01, 3.0, 10, 10, 4, 1.5)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan of two short runs."""
    monkeypatch.setitem(PLANS, "tiny", TINY)


def result(variant: str, seed: int, ate_cm: float, scene: str = "office") -> BenchRun:
    return BenchRun(scene, variant, seed, replace(ERRORS, ate_m=ate_cm / 100))


@pytest.mark.slow  # 30 s of compilation; notebooks/evaluate.ipynb runs the same path in the quick suite
def test_two_runs_from_start_to_tables(tiny: None, tmp_path: Path) -> None:
    # Proves that the stubs, the pipeline and the metrics fit together, and that a second call runs nothing.
    # Oracle: a run without lines gives other numbers; stored files that do not change; a trajectory within 5 cm.
    report = bench(tmp_path, "tiny")
    assert [(r.variant, r.errors.frames, r.errors.tracked) for r in report.results] == [("full", 10, 10), ("C", 10, 10)]
    assert all(0 < r.errors.ate_m < 0.05 for r in report.results), report.results
    assert report.results[0].errors.ate_m != report.results[1].errors.ate_m
    stored = sorted((tmp_path / "runs").iterdir())
    before = [path.stat().st_mtime_ns for path in stored]
    assert bench(tmp_path, "tiny").results == report.results
    assert [path.stat().st_mtime_ns for path in stored] == before
    assert (tmp_path / "ablations.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "tables.md").read_text() == report.markdown()


def test_what_was_finished_before_an_interruption_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that Ctrl-C loses the running job alone: the next call goes on with it. Oracle: the jobs really run.
    ran: list[str] = []

    def measure(stage: object, variant: object) -> Errors:
        ran.append(variant.key)  # type: ignore[attr-defined]
        if ran == ["full", "B"]:
            raise KeyboardInterrupt
        return ERRORS

    monkeypatch.setattr(runner, "measure", measure)
    monkeypatch.setattr(runner.Stage, "set", classmethod(lambda cls, course, seed: Job(course, seed, "")))
    jobs = Plan("p", (Group(TINY.groups[0].course, ("full", "B", "C"), 1),)).jobs()
    with pytest.raises(KeyboardInterrupt):
        runner.run_jobs(jobs, Store(tmp_path))
    assert len(list((tmp_path / "runs").iterdir())) == 1
    assert [r.variant for r in runner.run_jobs(jobs, Store(tmp_path))] == ["full", "B", "C"]
    assert ran == ["full", "B", "B", "C"]


def test_a_stored_run_of_other_settings_is_not_taken(tmp_path: Path) -> None:
    # Proves that a changed course or setting is run again, and that a spoilt file is named.
    job = TINY.jobs()[0]
    store = Store(tmp_path)
    assert store.load(job) is None
    store.save(job, ERRORS)
    assert store.load(job) == BenchRun("room", "full", 0, ERRORS)
    longer = replace(job, course=replace(job.course, frames=11))
    assert store.load(longer) is None
    store.path(job).write_text("{}")
    with pytest.raises(InputError, match="delete it"):
        store.load(job)


def test_fingerprints_tell_all_variants_apart() -> None:
    # Proves that no two variants that differ in their settings share a fingerprint, kernels included.
    course = TINY.groups[0].course
    same_settings = {"pnp", "D", "full"}  # they differ in the start of poses, and so in the name of their file
    prints = {key: fingerprint(Job(course, 0, key)) for key in VARIANTS if key not in same_settings - {"full"}}
    assert len(set(prints.values())) == len(prints)


def test_tables_hold_means_and_standard_deviations() -> None:
    # Proves the numbers of the tables. Oracle: computed by hand; full 2 and 4 cm, C 5 and 9 cm.
    report = BenchReport(
        Plan("p", (Group(Course("office", 10, 8.0), ("full", "C"), 2),), 0),
        (result("full", 0, 2.0), result("full", 1, 4.0), result("C", 0, 5.0), result("C", 1, 9.0)),
    )
    text = report.markdown()
    assert "| office | full system | 2 | 3.00 +- 1.41 |  |  | 0.80 +- 0.00 |  | 0.30 +- 0.00 | 5.00 +- 0.00 |" in text
    assert "| office | C: without lines | 2 | 7.00 +- 2.83 | 4.00 +- 1.41 | 2.33 |" in text
    assert text.count("imulated") >= 3
    rows = list(csv.DictReader(io.StringIO(report.csv())))
    assert [float(row["ate_m"]) for row in rows] == [0.02, 0.04, 0.05, 0.09]
    assert set(rows[0]) == {"simulated", "scene", "variant", "seed"} | {field.name for field in fields(Errors)}


def test_a_seed_without_its_full_run_is_not_compared() -> None:
    # Proves that differences are taken seed by seed. Oracle: full on seed 1 alone.
    results = [result("full", 1, 4.0), result("C", 0, 5.0), result("C", 1, 9.0)]
    np.testing.assert_allclose(tables.paired(results, "office", "C"), [5.0])
    assert tables.cell(np.array([5.0])) == "5.00"


def test_a_plan_runs_each_job_once_and_by_walk() -> None:
    # Proves that groups that overlap share their runs, and that a walk is rendered once. Oracle: counts.
    jobs = PLANS["quick"].jobs()
    assert len({job.name for job in jobs}) == len(jobs)
    walks = [(job.course.scene, job.seed) for job in jobs]
    assert len(set(walks)) == 1 + sum(walks[k] != walks[k + 1] for k in range(len(walks) - 1))
    assert all(job.variant in VARIANTS for job in jobs)
    some = PLANS["quick"].limited(["corridor"], ["full", "C"], 2, 7).jobs()
    assert [job.name for job in some] == ["corridor-7-full", "corridor-7-C", "corridor-8-full", "corridor-8-C"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--plan", "huge"), "`plan` is 'huge'; it must be one of small, quick, full"),
        (("--scenes", "attic"), "`scenes` holds ['attic']; choose among office"),
        (("--variants", "E"), "`variants` holds ['E']; choose among full"),
        (("--variants", ","), "`variants` holds nothing"),
    ],
)
def test_a_wrong_argument_is_one_line(arguments: tuple[str, ...], message: str, tmp_path: Path) -> None:
    # Proves that a wrong name ends before any work, with what can be chosen.
    outcome = CliRunner().invoke(make_app(), ["bench", "paper", "-o", str(tmp_path / "out"), *arguments])
    assert outcome.exit_code == 2
    assert message in outcome.stderr
    assert not (tmp_path / "out").exists()


def test_an_output_that_is_a_file_is_refused(tmp_path: Path) -> None:
    # Proves that nothing is run whose result could not be written.
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        bench(tmp_path / "file", "small")


def test_the_command_prints_the_tables(tiny: None, tmp_path: Path) -> None:
    # Proves the command, on runs that are stored already. Oracle: the text of the report.
    for job in TINY.jobs():
        Store(tmp_path).save(job, ERRORS)
    outcome = CliRunner().invoke(make_app(), ["bench", "paper", "--plan", "tiny", "-o", str(tmp_path)])
    assert outcome.exit_code == 0, outcome.output
    assert outcome.stdout.strip() == (tmp_path / "tables.md").read_text().strip()
    assert json.loads((tmp_path / "runs" / "room-0-C.json").read_text())["simulated"] is True


@pytest.mark.parametrize("name", ["frames", "rate", "key_points", "keyframe_distance"])
def test_a_course_is_checked(name: str) -> None:
    # Proves that a course that cannot be walked is refused by name.
    with pytest.raises(InputError, match=f"`{name}` is 0"):
        replace(TINY.groups[0].course, **{name: 0})
