"""What a batch's rows come to: means, medians, paired differences, errors of trajectories."""

from dataclasses import replace

import numpy as np
import pytest
import tiny_suites as tiny
from bench_rows import EXTERNAL, ROWS, row
from scipy.stats import ttest_rel

from vggtgeo.benchmark import report, tables
from vggtgeo.benchmark.rows import Summary, paired


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
    found = {name: (pairs, se3.mark) for _, name, pairs, se3, *_ in tables.differences(recorded, rows).lines}
    assert found == {"walk": ("5", "worse"), "hall": ("5", ""), "all": ("2", "")}


def test_medians_stand_beside_means() -> None:
    # Proves that from three seeds on a cell has the median over them, the mean over sequences that of the medians, and
    # from three sequences on a column of its own the median over those. Oracle: by hand, with an outlier.
    suite = tiny.suite(tiny.TEXT.replace("[[setting]]", '[[sequence]]\nname = "extra"\npath = "x"\n\n[[setting]]', 1))
    errors = {"walk": (1.0, 2.0, 9.0), "hall": (3.0, 3.0, 3.0), "extra": (5.0, 6.0, 40.0)}
    rows = [row(name, "full", seed, cm) for name, own in errors.items() for seed, cm in enumerate(own)]
    assert tables.accuracy(suite, rows, tables.SE3).heads == ("walk", "hall", "extra", "mean", "median")
    ((_, *line),) = tables.accuracy(suite, rows, tables.SE3).lines
    assert [one.text for one in line] == ["4.00 ± 4.36", "3.00 ± 0.00", "17.00 ± 19.92", "8.00", "4.00"]
    assert [one.median for one in line] == ["2.00", "3.00", "6.00", "3.67", ""]
    assert "standard deviation over seeds / median." in report.markdown(suite, rows)
    assert "/" not in report.grid(tables.accuracy(suite, [one for one in rows if one["seed"] < 2], tables.SE3))


def test_a_mean_is_over_the_sequences_that_all_have() -> None:
    # Proves that a system that is missing on a hard sequence gets no better mean by it. Oracle: by hand.
    rows = [one for one in ROWS if (one["sequence"], one["setting"]) != ("hall", "bare")]
    rows += [row("extra", "full", 0, 1.0), row("extra", "bare", 0, 3.0)]
    suite = tiny.suite(tiny.TEXT.replace("[[setting]]", '[[sequence]]\nname = "extra"\npath = "x"\n\n[[setting]]', 1))
    assert tables.accuracy(suite, rows, tables.SE3).heads == ("walk", "hall", "extra", "mean of 2")
    lines = {name: cells for name, *cells in tables.accuracy(suite, rows, tables.SE3).lines}
    assert [one.text for one in lines["without | lines"]] == ["7.00 ± 2.00", "", "3.00", "5.00"]


def test_a_free_scale_has_no_error_at_true_scale() -> None:
    # Proves that runs without a scale are called free after SE(3), in the table and in the differences, and are
    # compared after Sim(3). Oracle: by hand.
    rows = [*ROWS[:3], *({**one, "metric": False} for one in ROWS[3:6])]
    text = report.markdown(tiny.suite(), rows)
    assert "| without \\| lines | free |" in text
    assert "| without \\| lines | walk | 3 |  | **+2.00 ± 1.24** |" in text
    assert "| walk | without \\| lines | 3 | 27/30 | free | 3.50 ± 1.00 / 3.50 |" in text


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
    lines = {name: cells for name, *cells in tables.accuracy(suite, rows, tables.SE3).lines}
    assert lines["without | lines"] == [tables.Cell("2.00 (1 of 3)"), tables.Cell("1 failed, 1 crash")]
    assert lines["full system"][0] == tables.Cell("3.00 ± 1.00", "best", "3.00")
    assert lines["Other-SLAM"][0] == tables.Cell("5.00", "second")
    assert tables.accuracy(suite, rows, tables.SE3).heads == ("walk", "hall")


def test_accuracy_is_ranked_at_equal_coverage_only() -> None:
    # Proves that a system which was lost is neither the best nor in a mean, that coverage stands beside the error, and
    # that the others' mean does not lose sequences by it. Oracle: by hand.
    rows = [
        row(name, setting, 0, cm, coverage=share)
        for name in ("walk", "hall")
        for setting, cm, share in (("full", 3.0, 1.0), ("bare", 5.0, 0.95), ("other", 1.0, 0.2))
    ]
    rows[-1] |= {"external": "a.txt"}
    suite = tiny.suite(tiny.TEXT + EXTERNAL)
    lines = {name: cells for name, *cells in tables.accuracy(suite, rows, tables.SE3).lines}
    assert tables.accuracy(suite, rows, tables.SE3).heads == ("walk", "hall", "mean")
    assert lines["full system"] == [tables.Cell("3.00 at 100 %", "best")] * 2 + [tables.Cell("3.00", "best")]
    assert lines["without | lines"] == [tables.Cell("5.00 at 95 %", "second")] * 2 + [tables.Cell("5.00", "second")]
    assert lines["Other-SLAM"] == [tables.Cell("1.00 at 20 %")] * 2 + [tables.Cell("")]


def test_what_cannot_be_compared_is_neither_ranked_nor_averaged() -> None:
    # Proves that the status of a row keeps it out of the numbers, and stands in their place with the reasons below.
    # Oracle: by hand.
    rows = [*ROWS[:3], *({**one, "status": "not comparable", "message": "world to camera"} for one in ROWS[3:6])]
    text = report.markdown(tiny.suite(), rows)
    assert "| without \\| lines | 3 not comparable |" in text
    assert "| walk | bare | 0 | not comparable | world to camera |" in text
    assert "## Against" not in text
