"""Constant offsets of clock and body between a truth and an estimate: found, with their deviations, or undetermined."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from vggtgeo.cli.evaluate import evaluate
from vggtgeo.evaluation import Offsets, estimate_offsets, shifted
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputWarning

app = typer.Typer()
app.command()(evaluate)

SECONDS = 10.0
LEVER = np.array([0.1, -0.05, 0.02])
TURN = Rotation.from_rotvec([0.1, 0.05, -0.3])


def _pair(
    seed: int,
    late: float = 0.0,
    lever: np.ndarray | None = None,
    turn: Rotation | None = None,
    drift: float = 0.0,
    turning: float = 0.3,
    axis: tuple[float, float, float] = (1.0, 1.0, 1.0),
    moving: float = 0.3,
    rough: float = 0.0,
) -> tuple[Trajectory, Trajectory]:
    """An estimate at 10 Hz, right to 5 mm and 2 mrad a direction, and a truth at 100 Hz of another world whose clock is
    `late`. drift: of the estimate, metres a pose. moving 0: on a straight line, at constant velocity. rough: noise of
    the truth, metres and radians.
    """
    rng = np.random.default_rng(seed)
    knots = np.arange(-2.0, SECONDS + 3.0)
    places = np.cumsum(rng.normal(0, moving, (len(knots), 3)), axis=0) + (moving == 0) * 0.4 * knots[:, None]
    turns = np.cumsum(rng.normal(0, turning, (len(knots), 3)), axis=0) * axis
    place, turned = CubicSpline(knots, places), CubicSpline(knots, turns)

    def poses(times: np.ndarray) -> np.ndarray:
        found = np.tile(np.eye(4), (len(times), 1, 1))
        found[:, :3, :3], found[:, :3, 3] = Rotation.from_rotvec(turned(times)).as_matrix(), place(times)
        return found

    images, samples = np.arange(0, SECONDS, 0.1), np.arange(0, SECONDS, 0.01)
    estimate, body, world = poses(images), np.eye(4), np.eye(4)
    walk = np.cumsum(rng.normal(0, drift, (len(images), 3)), axis=0)
    estimate[:, :3, 3] += rng.normal(0, 0.005, (len(images), 3)) + walk
    noise = Rotation.from_rotvec(rng.normal(0, 0.002, (len(images), 3)) + 0.4 * walk).as_matrix()
    estimate[:, :3, :3] = noise @ estimate[:, :3, :3]
    body[:3, 3] = np.zeros(3) if lever is None else lever
    body[:3, :3] = np.eye(3) if turn is None else turn.as_matrix()
    world[:3, :3], world[:3, 3] = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), [1.0, 2.0, 3.0]
    true = world @ poses(samples) @ body
    true[:, :3, 3] += rng.normal(0, rough, (len(samples), 3))
    true[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, rough, (len(samples), 3))).as_matrix() @ true[:, :3, :3]
    return Trajectory(images, estimate), Trajectory(samples - late, true)


def _offsets(estimate: Trajectory, truth: Trajectory) -> Offsets:
    found = estimate_offsets(estimate, truth)
    assert found is not None
    return found


@pytest.mark.parametrize("drift", [0.0, 0.004], ids=["white noise", "white noise and drift"])
def test_offsets_are_within_their_deviations(drift: float) -> None:
    # Proves that clock, lever arm and axes are found, and that errors are what the stated deviations say, whether
    # neighbouring errors are alike or not. Oracle: offsets that were applied; the chi-square law of the NEES.
    scaled = []
    for seed in range(3):
        found = _offsets(*_pair(seed, 0.1, LEVER, TURN, drift))
        assert found.explains
        assert found.significant == ("time offset", "lever arm", "rotation")
        turned = Rotation.from_matrix(found.turn) * TURN.inv()
        errors = np.concatenate([[found.time - 0.1], found.lever - LEVER, turned.as_rotvec()])
        assert abs(errors[0]) < 0.006, f"clock off by {1e3 * errors[0]:.2f} ms"
        scaled.append(errors / np.concatenate([[found.time_sd], found.lever_sd, found.turn_sd]))
    nees = float(np.mean(np.square(scaled)))
    assert 0.4 < nees < 2.0, f"NEES of 3 x 7 numbers is {nees:.2f}, about 1 where deviations are right"
    assert np.abs(scaled).max() < 4.0, f"{np.abs(scaled).max():.1f} deviations off"


@pytest.mark.parametrize("late", [-0.3, 2.7])
def test_a_clock_that_is_late_is_told(late: float) -> None:
    # Proves that a clock alone is found to a millisecond, at once or seconds away, that nothing else is made
    # responsible, and that what is left is the noise. Oracle: 5 mm a direction.
    found = _offsets(*_pair(1, late))
    assert found.significant == ("time offset",)
    assert found.time == pytest.approx(late, abs=1.5e-3)
    assert found.ate > 4 * found.ate_left
    assert found.ate_left == pytest.approx(0.005 * np.sqrt(3), rel=0.15)
    assert "time offset of the ground truth" in found.message


def test_noise_of_the_truth_moves_no_clock() -> None:
    # Proves that a truth with noise of its own, which is smaller between its poses as interpolation averages, does not
    # draw the offset there. Oracle: poses of the estimate at every tenth of the truth's, which is exactly at one.
    found = [_offsets(*_pair(seed, 0.1, turning=0.02, rough=0.001)) for seed in range(2)]
    scaled = [(one.time - 0.1) / one.time_sd for one in found]
    assert np.abs(scaled).max() < 3.0, f"{scaled} deviations off"


def test_a_lever_arm_is_found_where_the_clock_is_right() -> None:
    # Proves that a marker beside the lens is told to millimetres, and is no clock. Oracle: what was applied.
    found = _offsets(*_pair(2, lever=LEVER))
    assert found.significant == ("lever arm",)
    np.testing.assert_allclose(found.lever, LEVER, atol=5e-3)
    assert abs(found.time) < 3 * found.time_sd


@pytest.mark.parametrize("drift", [0.0, 0.004])
def test_an_estimate_that_is_only_wrong_has_no_offset(drift: float) -> None:
    # Proves that noise and drift are not explained away. Oracle: there is no offset; the test's level is 0.001.
    for seed in range(2):
        found = _offsets(*_pair(seed, drift=drift))
        assert found.significant == (), f"seed {seed}: {found}"
        assert not found.explains
        assert found.ate_left == found.ate


def test_what_the_motion_leaves_open_is_not_determined() -> None:
    # Proves that a lever arm without rotation, its part along the only axis of rotation, and a clock on a straight line
    # at constant velocity are called undetermined, noise being no motion. Oracle: the geometry.
    straight = _offsets(*_pair(0, turning=0.0))
    assert np.isinf(straight.lever_sd).all(), str(straight)
    level = _offsets(*_pair(0, lever=LEVER, axis=(0.0, 0.0, 1.0)))
    assert np.isinf(level.lever_sd).tolist() == [False, False, True], str(level)
    np.testing.assert_allclose(level.lever[:2], LEVER[:2], atol=6e-3)
    constant = _offsets(*_pair(0, late=0.1, turning=0.0, moving=0.0))
    assert np.isinf(constant.time_sd), str(constant)
    assert "not determined" in str(constant)
    assert constant.to_dict()["time_offset_s"] is None


def test_offsets_of_few_or_still_poses_are_none() -> None:
    # Proves that fewer than ten poses, and a truth at one place, end in a statement and not in a fault.
    estimate, truth = _pair(0)
    assert estimate_offsets(estimate.select(slice(0, 9)), truth) is None
    still = Trajectory(truth.timestamps, np.tile(np.eye(4), (len(truth), 1, 1)))
    assert _offsets(estimate, still).significant == ()
    assert not _offsets(truth, truth).explains


def test_a_shifted_truth_is_interpolated() -> None:
    # Proves that a truth at the images' own times can be moved by a part of their interval. Oracle: the dense truth.
    _, truth = _pair(3)
    sparse = truth.select(slice(0, None, 5))
    moved = shifted(Trajectory(sparse.timestamps[4:-4], sparse.poses[4:-4]), sparse, 0.02)
    rows = np.isin(np.round(moved.timestamps, 6), np.round(sparse.timestamps[4:-4], 6))
    expected = truth.positions[np.searchsorted(truth.timestamps, sparse.timestamps[4:-4] - 0.02 - 1e-6)]
    np.testing.assert_allclose(moved.positions[rows], expected, atol=1e-3)


def test_the_command_tells_applies_and_removes_an_offset(tmp_path: Path) -> None:
    # Proves that `evaluate` keeps the plain error, says what explains it, and gives the error without it, by the
    # estimated offset or by a given one. Oracle: noise of 5 mm a direction, a clock 0.1 s late.
    estimate, truth = _pair(4, late=0.1)
    estimate.save_tum(tmp_path / "estimate.txt")
    truth.save_tum(tmp_path / "truth.txt")
    files = [str(tmp_path / "estimate.txt"), str(tmp_path / "truth.txt"), "--json"]
    with pytest.warns(InputWarning, match="most of the error is a constant offset"):
        told = json.loads(CliRunner().invoke(app, [*files, "--estimate-offset"]).stdout)
    assert told["offsets"]["time_offset_s"] == pytest.approx(0.1, abs=1.5e-3)
    assert told["offsets"]["significant"] == ["time offset"]
    assert told["ate_se3_m"]["rmse"] > 0.02
    given = json.loads(CliRunner().invoke(app, [*files, "--time-offset", "0.1"]).stdout)
    for report in (told["without_offsets"], given):
        assert report["ate_se3_m"]["rmse"] == pytest.approx(0.005 * np.sqrt(3), rel=0.15)
    assert "without_offsets" not in given
    assert not given["offsets"]["explains_most"]


def test_offsets_of_a_recorded_truth(shared_cases: Path, tmp_path: Path) -> None:
    # Proves it on the motion of a person with a camera: one clock right, one 0.3 s late. Oracle: what the script wrote.
    script = shared_cases / "clock_offset.py"
    truth = shared_cases.parent / "data" / "corridor-office" / "groundtruth.txt"
    subprocess.run([sys.executable, script, truth], cwd=tmp_path, check=True)
    for late in (0.0, 0.3):
        estimate = Trajectory.load_tum(tmp_path / "estimate.txt")
        found = _offsets(estimate, Trajectory.load_tum(tmp_path / f"truth-{late:g}.txt"))
        assert found.time == pytest.approx(late, abs=1e-3)
        assert found.significant == (("time offset",) if late else ())
