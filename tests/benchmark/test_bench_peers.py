"""Other systems beside ours: their trajectories as rows, their published figures apart."""

from pathlib import Path

import numpy as np
import pytest
import tiny_suites as tiny
from bench_rows import EXTERNAL, ROWS, row
from reported import raises
from scipy.spatial.transform import Rotation

from vggtgeo.benchmark import report
from vggtgeo.benchmark.measure import trajectory_errors
from vggtgeo.benchmark.rows import Row, paired
from vggtgeo.benchmark.runner import external_rows, subtract_baseline
from vggtgeo.benchmark.suite import Suite
from vggtgeo.benchmark.tables import published
from vggtgeo.geometry.trajectory import Trajectory


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


def _walk(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (100, 1, 1))
    poses[:, :3, 3] = rng.normal(scale=0.1, size=(100, 3)).cumsum(axis=0)
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.03, size=(100, 3)).cumsum(axis=0)).as_matrix()
    return poses


def _systems(tmp_path: Path, ours: np.ndarray, theirs: Trajectory) -> tuple[Suite, list[Row]]:
    """A run of ours on the walk, and the trajectory of another system beside it."""
    truth = Trajectory(np.arange(100) / 10, _walk(0))
    place = tmp_path / "out/runs/walk.full.0"
    truth.save_tum(place / "truth.txt")
    Trajectory(truth.timestamps, ours).save_tum(place / "estimate.txt")
    theirs.save_tum(tmp_path / "other/walk.txt")
    suite = tiny.suite(tiny.TEXT + EXTERNAL)
    errors, _ = trajectory_errors(Trajectory(truth.timestamps, ours), truth)
    rows = [row("walk", "full", 0, None, **errors), *external_rows(suite, tiny.jobs(), place.parent, tmp_path)]
    return suite, subtract_baseline(suite, rows, place.parent)


def test_differences_are_over_the_time_that_both_cover(tmp_path: Path) -> None:
    # Proves that a system which was lost after a third is compared with ours over that third. Oracle: ours is exact
    # there and wrong by a decimetre after, theirs wrong by 3 cm; over all, ours would be worse.
    rng = np.random.default_rng(2)
    ours, theirs = _walk(0), _walk(0)
    ours[40:, :3, 3] += rng.normal(scale=0.1, size=(60, 3))
    theirs[:, :3, 3] += rng.normal(scale=0.03, size=(100, 3))
    suite, rows = _systems(tmp_path, ours, Trajectory(np.arange(33) / 10, theirs[:33]))
    assert rows[1]["coverage"] < 0.4
    assert rows[1]["ate_se3_m"] < rows[0]["ate_se3_m"]
    (found,) = paired(rows, "other", suite.base, "ate_se3_m", "walk")
    assert found == pytest.approx(rows[1]["ate_se3_m"], abs=1e-6)


def test_published_figures_have_source_and_protocol_and_stand_apart() -> None:
    # Proves that figures of others are never in a table of own ones. Oracle: the section they are in.
    text = report.markdown(tiny.suite(tiny.TEXT.replace("seeds = 3", 'seeds = 3\npublished = ["tum-freiburg1"]')), ROWS)
    before, _, after = text.partition("## Published by others")
    assert "DROID-SLAM" not in before
    assert "| DROID-SLAM (uncalibrated)* | 0.202 |" in after
    assert "Not measured here" in after
    lost = (
        "| ORB-SLAM3 | lost | 0.017 | 0.210 | lost | 0.034 | lost | lost | lost | 0.009 | C. Campos et al., ORB-SLAM3: "
    )
    assert lost in after
    assert "`-`" not in after
    other = report.section(published("averages"))
    assert "| SLAM3R* | - | - | 0.066 | - | - | Y. Liu et al., SLAM3R" in other
    assert "`-`: not published." in other
    with raises("`published`", "'x'"):
        tiny.suite(tiny.TEXT.replace("seeds = 3", 'seeds = 3\npublished = ["x"]'))
