"""`vggtgeo evaluate`: what it prints is what the metrics say."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import tiny_sequences as tiny
import typer
from reported import warns
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import vggtgeo.cli.evaluate
from vggtgeo.cli.evaluate import evaluate
from vggtgeo.cli.progress import errors_line
from vggtgeo.datasets import open_sequence
from vggtgeo.evaluation import MAX_TIME_DIFFERENCE, estimate_offsets, evaluate_trajectory
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
        json.dumps({**expected.as_dict(), "truth_in_metres": None, "offsets": offsets.as_dict(), "comparable": True})
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


def test_the_default_of_max_dt_is_that_of_the_library() -> None:
    # Proves that the copy of the constant, which keeps `--help` quick, is true.
    assert vggtgeo.cli.evaluate.MAX_TIME_DIFFERENCE == MAX_TIME_DIFFERENCE


def test_the_table_has_every_metric(tmp_path: Path) -> None:
    # Proves that a person reads ATE after either alignment and RPE, in centimetres and degrees.
    files = _files(tmp_path)
    files = files[0], files[1].rename(tmp_path / "groundtruth.txt")
    result = CliRunner().invoke(app, list(map(str, files)))
    assert result.exit_code == 0, result.output
    report = evaluate_trajectory(*_load(files))
    for value in (report.se3.statistics.rmse, report.sim3.statistics.rmse):
        assert f"{100 * value:.3f} cm" in result.output
    assert f"{np.degrees(report.relative.rotation_statistics.rmse):.3f} deg" in result.output
    assert "30 poses matched, of 30 estimated and 30 true" in " ".join(result.output.split())


def test_a_unit_is_printed_where_lengths_are_metres_only(tmp_path: Path) -> None:
    # Proves that errors are called cm where the truth is known to be in metres, and bare numbers of the truth's unit
    # where it is a run's of free scale, or a file that says nothing. Oracle: the summary of the run, the file's name.
    estimate, truth = _files(tmp_path)
    value = evaluate_trajectory(*_load((estimate, truth))).sim3.statistics.rmse
    (tmp_path / "run").mkdir()
    of_run = truth.rename(tmp_path / "run" / "trajectory.txt")
    said = {
        "free (no metric depth): lengths have no unit": "in the unit of GT, which is not the metre",
        "metric": None,
        None: "in the unit of GT, which is not known",
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


def test_a_file_of_a_run_has_the_scale_of_its_summary(tmp_path: Path) -> None:
    # Proves that `RUN/trajectory.txt` is judged as `RUN` is: of a free scale, without errors after SE(3).
    estimate, truth = _files(tmp_path)
    (tmp_path / "summary.json").write_text(json.dumps({"scale": "free (no metric depth): lengths have no unit"}))
    found = CliRunner().invoke(app, [str(estimate), str(truth)])
    assert "scale of the estimate: free" in found.output
    assert "ATE, SE(3)" not in found.output


def test_folders_stand_for_their_trajectories(tmp_path: Path) -> None:
    # Proves that a run's folder and a dataset's folder can be given. Oracle: a perfect estimate of a tiny dataset.
    dataset = tiny.seven_scenes(tmp_path / "dataset", (0, 1, 2, 3))
    truth = open_sequence(dataset).ground_truth()
    assert truth is not None
    truth.save_tum(tmp_path / "run" / "trajectory.txt")
    result = CliRunner().invoke(app, [str(tmp_path / "run"), str(dataset), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["ate_se3_m"]["rmse"] == pytest.approx(0.0, abs=1e-8)


def test_what_the_user_gave_wrong_is_an_input_error(tmp_path: Path) -> None:
    # Proves that bad input leaves as `InputError`, which the program's entry turns into one line, not a traceback.
    estimate, _ = _files(tmp_path)
    tiny.images(tmp_path / "images")
    for truth in (tmp_path / "no.txt", tmp_path / "images"):
        result = CliRunner().invoke(app, [str(estimate), str(truth)])
        assert isinstance(result.exception, InputError)
        assert f"`{truth}`" in str(result.exception)


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


@pytest.mark.parametrize("inverted", [False, True], ids=["itself", "world to camera"])
def test_a_camera_that_hardly_turns_tells_of_strangers_over_longer_times(tmp_path: Path, inverted: bool) -> None:
    # Proves that poses of the other direction are told where a camera turns by 1 degree in a tenth of the sequence, of
    # which rotations were not asked, and the right ones are not. Oracle: which of both was written.
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 2, 200)
    poses[:, 1, 3] = 0.3 * np.sin(np.linspace(0, 3, 200))
    poses[:, :3, :3] = Rotation.from_rotvec(np.radians(np.linspace(0, 10, 200))[:, None] * [0, 1, 0]).as_matrix()
    times = np.arange(200) / 30
    Trajectory(times, poses).save_tum(tmp_path / "truth.txt")
    Trajectory(times, np.linalg.inv(poses) if inverted else poses).save_tum(tmp_path / "trajectory.txt")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        outcome = CliRunner().invoke(app, [str(tmp_path / "trajectory.txt"), str(tmp_path / "truth.txt")])
    assert outcome.exit_code == (3 if inverted else 0), outcome.output
    assert [True for one in warned if "hardly rotates" in str(one.message)] == [True] * inverted
    assert [True for one in warned if "they are world to camera" in str(one.message)] == [True] * inverted


def test_lengths_in_another_unit_are_told_where_they_are_compared() -> None:
    # Proves that a metric run beside a truth of five times its size says so in its line and in the report's, and one of
    # its own size does not. Oracle: the factor.
    truth = _walk(1, turning=True)
    for factor in (1.0, 5.0):
        poses = truth.poses.copy()
        poses[:, :3, 3] /= factor
        report = evaluate_trajectory(Trajectory(truth.timestamps, poses), truth)
        line = errors_line({**report.as_dict(), "in_metres": True}, free=False)
        assert ("with scale 5: are depth and ground truth in the same unit?" in line) == (factor == 5.0)
        assert ("the scale is 5: the units differ" in str(report)) == (factor == 5.0)


def test_an_estimate_without_scale_or_of_a_part_is_a_success(tmp_path: Path) -> None:
    # Proves that what can be compared ends with 0: in another unit, and over a tenth of the sequence.
    truth = _walk(1, turning=True)
    truth.save_tum(tmp_path / "truth.txt")
    scaled = truth.poses.copy()
    scaled[:, :3, 3] *= 20
    for estimate in (Trajectory(truth.timestamps, scaled), truth.select(slice(0, 20))):
        estimate.save_tum(tmp_path / "trajectory.txt")
        outcome = CliRunner().invoke(app, [str(tmp_path / "trajectory.txt"), str(tmp_path / "truth.txt")])
        assert outcome.exit_code == 0, outcome.output
        assert "warning: " in outcome.output


def test_a_run_of_free_scale_has_no_errors_in_metres(tmp_path: Path) -> None:
    # Proves that SE(3) errors are left out where the run says that its scale is free, and that a metric run is
    # labelled. Oracle: the summaries.
    files = _files(tmp_path)
    for scale in ("free (no metric depth): lengths have no unit", "metric"):
        (tmp_path / "summary.json").write_text(json.dumps({"scale": scale}))
        result = CliRunner().invoke(app, [str(tmp_path), str(files[1])])
        assert result.exit_code == 0, result.output
        assert f"scale of the estimate: {scale}" in result.output
        assert ("ATE, SE(3)" in result.output) == (scale == "metric")
        assert "ATE, Sim(3)" in result.output
