"""The command `bench`, from its arguments to its tables and exit codes."""

from pathlib import Path

import pytest
import tiny_suites as tiny
from reported import raises
from typer.testing import CliRunner

from vggtgeo.benchmark import runner
from vggtgeo.cli.main import make_app
from vggtgeo.io.files import locked


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nosuch",), "`nosuch`"),
        (("quick", "--sequences", "attic"), "`sequences` must be of office"),
        (("quick", "--data", "/no/such/place"), "`data` must be a folder, got `/no/such/place`"),
        (("quick", "--timeout-minutes", "0"), "`timeout_minutes` must be positive, got 0.0"),
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
    assert (tmp_path / "out/runs.csv").read_text().count("walk") == 2
    assert (tmp_path / "out/report.html").is_file()
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
    assert "Missing recordings: a" in outcome.stdout


def test_two_batches_keep_off_each_other(tmp_path: Path) -> None:
    # Proves that a folder that a batch writes into is refused to a second, which would take its runs away, and is free
    # after it. Oracle: the lock, held here.
    suite = tiny.suite(tiny.TEXT.replace('simulate = { scene = "room", frames = 4 }', 'path = "gone"'))
    part = {"sequences": ["walk"], "data": [tmp_path]}
    (tmp_path / "out").mkdir()
    with locked(tmp_path / "out" / ".bench.lock"), raises(tmp_path / "out"):
        runner.bench(suite, tmp_path / "out", **part)
    assert not (tmp_path / "out" / "runs.csv").exists()
    report = runner.bench(suite, tmp_path / "out", **part)
    assert [row["status"] for row in report.rows] == ["absent"] * 6
    assert not (tmp_path / "out" / ".bench.lock").exists()


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
