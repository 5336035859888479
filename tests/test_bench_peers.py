"""Other systems beside ours: their trajectories as rows, their published figures apart."""

from pathlib import Path

import numpy as np
import pytest
import tiny_suites as tiny
from bench_rows import EXTERNAL, ROWS

from vggtgeo.benchmark import markdown
from vggtgeo.benchmark.external import external_rows, tell_missing
from vggtgeo.benchmark.published import published
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning


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
