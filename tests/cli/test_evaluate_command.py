"""`vggtgeo evaluate`: what it prints is what the metrics say."""

import json
from pathlib import Path

import numpy as np
import pytest
import tiny_sequences as tiny
import typer
from reported import warns
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from vggtgeo.cli.evaluate import evaluate
from vggtgeo.datasets import open_sequence
from vggtgeo.evaluation import estimate_offsets, evaluate_trajectory
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning

app = typer.Typer()
app.command()(evaluate)


def _files(folder: Path) -> tuple[Path, Path]:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(30, 3)).cumsum(axis=0)
    noisy = poses.copy()
    noisy[:, :3, 3] += rng.normal(scale=0.05, size=(30, 3))
    noisy[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.02, size=(30, 3))).as_matrix()
    times = np.arange(30) / 10.0
    Trajectory(times, noisy).save_tum(folder / "trajectory.txt")
    Trajectory(times, poses).save_tum(folder / "truth.txt")
    return folder / "trajectory.txt", folder / "truth.txt"


def _load(files: tuple[Path, Path]) -> tuple[Trajectory, Trajectory]:
    return Trajectory.load_tum(files[0]), Trajectory.load_tum(files[1])


def test_json_has_the_metrics(tmp_path: Path) -> None:
    # Proves that the numbers printed are those of the metrics on the same files, with the options passed on.
    files = _files(tmp_path)
    result = CliRunner().invoke(app, [*map(str, files), "--json", "--delta", "3", "--all-pairs", "--max-dt", "0.02"])
    assert result.exit_code == 0, result.output
    expected = evaluate_trajectory(*_load(files), max_dt=0.02, delta=3, all_pairs=True)
    offsets = estimate_offsets(*_load(files), max_dt=0.02)
    assert offsets is not None
    assert json.loads(result.output) == json.loads(
        json.dumps({**expected.to_dict(), "truth_in_metres": None, "offsets": offsets.to_dict(), "comparable": True})
    )


def test_a_run_in_metres_of_another_size_is_of_another_sequence(tmp_path: Path) -> None:
    # Proves that a run which says that it is metric, and has a quarter of the truth's size, is not comparable; a file,
    # whose scale nobody knows, is compared.
    _, truth = _files(tmp_path)
    small = Trajectory.load_tum(truth)
    poses = small.poses.copy()
    poses[:, :3, 3] /= 4
    Trajectory(small.timestamps, poses).save_tum(tmp_path / "trajectory.txt")
    assert CliRunner().invoke(app, [str(tmp_path / "trajectory.txt"), str(truth)]).exit_code == 0
    (tmp_path / "summary.json").write_text(json.dumps({"scale": "metric, by the depth"}))
    with warns(4):
        found = CliRunner().invoke(app, [str(tmp_path), str(truth)])
    assert found.exit_code == 3
    assert "NOT COMPARABLE" in found.output


def test_a_unit_is_printed_where_lengths_are_metres_only(tmp_path: Path) -> None:
    # Proves that errors are called cm where the truth is known to be in metres, and bare numbers of the truth's unit
    # where it is a run's of free scale, or a file that says nothing; and that an estimate of free scale has no errors
    # after SE(3). Oracle: the summary of the run, the file's name.
    estimate, truth = _files(tmp_path)
    report = evaluate_trajectory(*_load((estimate, truth)))
    value, degrees = report.sim3.statistics.rmse, np.degrees(report.relative.rotation_statistics.rmse)
    for scale in ("free (no metric depth): lengths have no unit", "metric"):
        (tmp_path / "summary.json").write_text(json.dumps({"scale": scale}))
        printed = CliRunner().invoke(app, [str(tmp_path), str(truth)]).output
        assert all(part in printed for part in (f"scale of the estimate: {scale}", f"{degrees:.3f} deg"))
        assert [name in printed for name in ("ATE, SE(3)", "ATE, Sim(3)")] == [scale == "metric", True]
    (tmp_path / "summary.json").unlink()
    (tmp_path / "run").mkdir()
    of_run = truth.rename(tmp_path / "run" / "trajectory.txt")
    said = {
        "free (no metric depth): lengths have no unit": "in the unit of GT, which is not the metre",
        "metric": None,
        None: "in the unit of GT, which is unknown",
    }
    for scale, words in said.items():
        (tmp_path / "run" / "summary.json").unlink(missing_ok=True)
        if scale is not None:
            (tmp_path / "run" / "summary.json").write_text(json.dumps({"scale": scale}))
        found = CliRunner().invoke(app, [str(estimate), str(of_run)])
        assert found.exit_code == 0, found.output
        assert (" cm" in found.output) == (words is None), f"{scale}: {found.output}"
        assert (words or f"{100 * value:.3f} cm") in " ".join(found.output.split())
        assert words is None or f"{value:.5g}" in found.output
    for name in ("groundtruth.txt", "rgbd_dataset_freiburg1_xyz-groundtruth.txt", "livingRoom0.gt.freiburg"):
        of_run = of_run.rename(tmp_path / "run" / name)
        assert " cm" in CliRunner().invoke(app, [str(estimate), str(of_run)]).output, name


def test_folders_stand_for_their_trajectories(tmp_path: Path) -> None:
    # Proves that a run's folder and a dataset's folder can be given. Oracle: a perfect estimate of a tiny dataset.
    dataset = tiny.seven_scenes(tmp_path / "dataset", (0, 1, 2, 3))
    truth = open_sequence(dataset).ground_truth()
    assert truth is not None
    truth.save_tum(tmp_path / "run" / "trajectory.txt")
    result = CliRunner().invoke(app, [str(tmp_path / "run"), str(dataset), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["ate_se3_m"]["rmse"] == pytest.approx(0.0, abs=1e-8)


def _walk(seed: int, turning: bool, begin: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, 3] = rng.normal(scale=0.05, size=(200, 3)).cumsum(axis=0)
    if turning:
        poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.03, size=(200, 3)).cumsum(axis=0)).as_matrix()
    return Trajectory(begin + np.arange(200) / 30, poses)


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        (_walk(2, turning=True), "estimated rotations do not match"),
        (_walk(2, turning=False), "estimated positions do not match"),
        (_walk(1, turning=True, begin=6.5), "only 5 of 200 poses match"),
        (_walk(1, turning=True, begin=9.0), None),
    ],
    ids=["another, turning", "another, not turning", "five match", "none match"],
)
def test_the_truth_of_another_sequence_is_no_success(tmp_path: Path, truth: Trajectory, said: str | None) -> None:
    # Proves that nothing that can be compared never ends with 0: a sentence, and 3, or an error where not three poses
    # match. Oracle: two random walks; a script that looks at the exit code.
    _walk(1, turning=True).save_tum(tmp_path / "trajectory.txt")
    truth.save_tum(tmp_path / "truth.txt")
    arguments = [str(tmp_path / "trajectory.txt"), str(tmp_path / "truth.txt"), "--json"]
    if said is None:
        assert isinstance(CliRunner().invoke(app, arguments).exception, InputError)
        return
    with pytest.warns(InputWarning) as warned:
        outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 3
    assert any(said in str(one.message) for one in warned), [str(one.message) for one in warned]
    assert "NOT COMPARABLE" in outcome.stderr
    written = json.loads(outcome.stdout)
    assert "ate_se3_m" in written
    assert not written["comparable"]
    assert any(said in text for text in written["warnings"])
