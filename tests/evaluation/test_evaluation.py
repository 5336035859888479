"""Metrics against the `evo` package, closed forms and brute force."""

import copy
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.core.units import Unit
from scipy.spatial.transform import Rotation

from vggtgeo.datasets import open_sequence
from vggtgeo.evaluation import (
    absolute_error,
    associate,
    coverage,
    evaluate_trajectory,
    heading,
    relative_error,
    rotation_angle,
    umeyama,
)
from vggtgeo.geometry.trajectory import Trajectory

TOLERANCE = 1e-9


def _truth(count: int = 120, rate: float = 30.0, seed: int = 0) -> Trajectory:
    """A smooth path with smooth turns, at an uneven clock."""
    rng = np.random.default_rng(seed)
    times = 100.0 + np.arange(count) / rate + rng.uniform(-0.2, 0.2, count) / rate
    phase = times[:, None] * np.array([0.9, 1.3, 0.7]) + rng.uniform(0, 6, 3)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.sin(phase)).as_matrix()
    poses[:, :3, 3] = np.cos(1.7 * phase) * [2.0, 0.5, 1.0]
    return Trajectory(times, poses)


def _estimate(truth: Trajectory, scale: float = 1.0, seed: int = 1) -> Trajectory:
    """The truth with noise, drift, another clock, another frame, and another scale."""
    rng = np.random.default_rng(seed)
    count = len(truth)
    poses = truth.poses.copy()
    poses[:, :3, 3] += rng.normal(scale=0.02, size=(count, 3)) + np.linspace(0, 0.1, count)[:, None]
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(rng.normal(scale=0.01, size=(count, 3))).as_matrix()
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    frame[:3, 3] = [5.0, -3.0, 1.0]
    poses = frame @ poses
    poses[:, :3, 3] *= scale
    return Trajectory(truth.timestamps + rng.uniform(-0.004, 0.004, count), poses)


def _evo(path: Path) -> PoseTrajectory3D:
    rows = np.loadtxt(path, ndmin=2)
    return PoseTrajectory3D(rows[:, 1:4], rows[:, [7, 4, 5, 6]], rows[:, 0])


def _evo_pair(tmp_path: Path, estimate: Trajectory, truth: Trajectory, max_dt: float = 0.01) -> tuple:
    estimate.save_tum(tmp_path / "estimate.txt")
    truth.save_tum(tmp_path / "truth.txt")
    return sync.associate_trajectories(_evo(tmp_path / "truth.txt"), _evo(tmp_path / "estimate.txt"), max_diff=max_dt)


def _evo_statistics(metric: metrics.PE, truth: PoseTrajectory3D, estimate: PoseTrajectory3D) -> dict[str, float]:
    metric.process_data((truth, estimate))
    return metric.get_all_statistics()


def _both_loaded(tmp_path: Path) -> tuple[Trajectory, Trajectory]:
    return Trajectory.load_tum(tmp_path / "estimate.txt"), Trajectory.load_tum(tmp_path / "truth.txt")


CASES = {
    "same clock": (slice(None), slice(None)),
    "longer truth": (slice(0, None, 3), slice(None)),
    "longer estimate": (slice(None), slice(5, 90, 2)),
    "parts": (slice(0, 80), slice(40, None)),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("scale", [1.0, 3.7])
def test_ate_agrees_with_evo(tmp_path: Path, case: str, scale: float) -> None:
    # Proves that ATE (rmse, mean, median, max) after SE(3) and Sim(3), and RPE after Sim(3), are evo's on the same
    # files, to 1e-9.
    full = _truth()
    estimate, truth = _estimate(full, scale).select(CASES[case][0]), full.select(CASES[case][1])
    reference, evo_estimate = _evo_pair(tmp_path, estimate, truth)
    report = evaluate_trajectory(*_both_loaded(tmp_path))
    assert report.matched == evo_estimate.num_poses
    for with_scale, result in ((False, report.se3), (True, report.sim3)):
        aligned = copy.deepcopy(evo_estimate)
        aligned.align(reference, correct_scale=with_scale)
        expected = _evo_statistics(metrics.APE(), reference, aligned)
        found = result.statistics
        errors = [
            abs(found.rmse - expected["rmse"]),
            abs(found.mean - expected["mean"]),
            abs(found.median - expected["median"]),
            abs(found.maximum - expected["max"]),
        ]
        assert max(errors) < TOLERANCE, f"differs from evo by {errors} (scale: {with_scale})"
    expected = _evo_statistics(metrics.RPE(), reference, aligned)["rmse"]  # aligned with its scale
    assert abs(report.relative_sim3.translation_statistics.rmse - expected) < TOLERANCE


@pytest.mark.parametrize("all_pairs", [False, True])
@pytest.mark.parametrize(("unit", "delta"), [("poses", 1), ("poses", 7), ("metres", 0.3), ("metres", 1.1)])
def test_rpe_agrees_with_evo(tmp_path: Path, unit: Literal["poses", "metres"], delta: float, all_pairs: bool) -> None:
    # Proves that RPE of translation and rotation, over poses and over a path, with either kind of pairs, a camera that
    # stands still at times included, is evo's on the same files, to 1e-9.
    truth = _truth(150)
    poses = truth.poses.copy()
    poses[40:50, :3, 3], poses[149, :3, 3] = poses[40, :3, 3], poses[148, :3, 3]
    truth = Trajectory(truth.timestamps, poses)
    reference, evo_estimate = _evo_pair(tmp_path, _estimate(truth), truth)
    found = evaluate_trajectory(*_both_loaded(tmp_path), delta=delta, all_pairs=all_pairs, unit=unit).relative
    of_evo = Unit.frames if unit == "poses" else Unit.meters
    for relation, errors in (
        (metrics.PoseRelation.translation_part, found.translation),
        (metrics.PoseRelation.rotation_angle_rad, found.rotation),
    ):
        metric = metrics.RPE(relation, delta, of_evo, all_pairs=all_pairs, pairs_from_reference=True)
        metric.process_data((reference, evo_estimate))
        assert len(errors) == len(metric.error) > 3
        error = np.abs(errors - metric.error).max()
        assert error < TOLERANCE, f"{relation}: differs from evo by {error}"


@pytest.mark.parametrize("all_pairs", [False, True])
def test_rpe_over_seconds_is_that_over_poses_on_an_even_clock(all_pairs: bool) -> None:
    # Proves pairs by time, gaps included. Oracle: pairs by counting where the clock is even; by hand where it is not.
    truth = _truth(60)
    even = Trajectory(np.arange(60) / 30.0, truth.poses)
    estimate = Trajectory(even.timestamps, _estimate(truth).poses)
    by_count = relative_error(estimate, even, 6, all_pairs)
    by_time = relative_error(estimate, even, 0.2, all_pairs, "seconds")
    np.testing.assert_allclose(by_time.translation, by_count.translation, atol=1e-12)
    assert by_time.interval == "0.2 seconds"
    gap = Trajectory(np.array([0.0, 0.1, 0.2, 1.0, 1.1]), truth.poses[:5])
    assert relative_error(gap, gap, 0.2, all_pairs, "seconds").translation.shape == (1 if all_pairs else 2,)


@pytest.mark.parametrize("vertical", [(0.0, 0.0, 1.0), (0.0, -2.0, 0.0), (0.3, 0.5, -0.2)])
def test_heading_finds_the_turn_about_the_vertical(vertical: tuple[float, float, float]) -> None:
    # Proves that a turn about the vertical and a shift are undone exactly, and that noise leaves the best of all turns.
    # Oracle: the motion that was applied; a search over the angle.
    rng = np.random.default_rng(7)
    axis = np.array(vertical) / np.linalg.norm(vertical)
    source = rng.normal(size=(40, 3))
    turn = Rotation.from_rotvec(2.5 * axis).as_matrix()
    found = heading(source, source @ turn.T + [1.0, -4.0, 2.0], vertical)
    assert np.abs(found.rotation - turn).max() < 1e-12
    np.testing.assert_allclose(found.translation, [1.0, -4.0, 2.0], atol=1e-12)
    target = source @ Rotation.random(rng=rng).as_matrix().T + rng.normal(scale=0.1, size=(40, 3))
    found = heading(source, target, vertical)
    centred = target - target.mean(0)
    cost = lambda rotation: float(((((source - source.mean(0)) @ rotation.T) - centred) ** 2).sum())
    angles = np.linspace(-np.pi, np.pi, 2001)
    assert cost(found.rotation) <= min(cost(Rotation.from_rotvec(angle * axis).as_matrix()) for angle in angles) + 1e-9


def test_each_alignment_removes_what_it_says() -> None:
    # Proves the four errors of one report: an estimate turned about z, tilted, and scaled in turn is brought back by
    # just those alignments that know of it. Oracle: zero, or not.
    truth = _truth()
    turned = Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix()
    tilted = Rotation.from_rotvec([0.4, 0.0, 0.0]).as_matrix()
    for name, rotation, scale, zeros in (
        ("as it is", np.eye(3), 1.0, {"unaligned", "yaw", "se3", "sim3"}),
        ("turned", turned, 1.0, {"yaw", "se3", "sim3"}),
        ("tilted", tilted, 1.0, {"se3", "sim3"}),
        ("scaled", tilted, 2.0, {"sim3"}),
    ):
        poses = truth.poses.copy()
        poses[:, :3, :3] = rotation @ truth.rotations
        poses[:, :3, 3] = scale * truth.positions @ rotation.T
        report = evaluate_trajectory(Trajectory(truth.timestamps, poses), truth)
        errors = {kind: getattr(report, kind).statistics.rmse for kind in ("unaligned", "yaw", "se3", "sim3")}
        assert {kind for kind, error in errors.items() if error < 1e-9} == zeros, f"{name}: {errors}"
        assert report.sim3.alignment.scale == pytest.approx(1 / scale)


def test_coverage_is_the_share_of_time_that_is_followed() -> None:
    # Proves that gaps and a missing end count, keyframes do not. Oracle: by hand, over ten seconds.
    poses = np.tile(np.eye(4), (101, 1, 1))
    truth = Trajectory(np.arange(101) / 10.0, poses)
    assert coverage(truth, truth) == pytest.approx(1.0)
    assert coverage(truth.select(slice(0, None, 10)), truth) == pytest.approx(1.0)
    assert coverage(truth.select(slice(0, 51)), truth) == pytest.approx(0.5)
    lost = np.r_[0:21, 60:101]
    assert coverage(truth.select(lost), truth) == pytest.approx(0.6)
    longer = Trajectory(np.arange(301) / 10.0 - 10.0, np.tile(np.eye(4), (301, 1, 1)))
    assert coverage(longer, truth) == pytest.approx(1.0)
    slow = Trajectory(3.0 * np.arange(21), _truth(21).poses)  # longer gaps are those of the truth itself
    assert (coverage(slow, slow), coverage(slow.select(slice(11)), slow)) == (1.0, 0.5)


@pytest.mark.parametrize("max_dt", [0.0, 0.002, 0.01, 0.05])
@pytest.mark.parametrize("swap", [False, True])
def test_association_agrees_with_evo(tmp_path: Path, max_dt: float, swap: bool) -> None:
    # Proves that the same poses are matched as by evo, shorter and longer trajectories both ways round.
    slow, fast = _truth(60, rate=20.0, seed=2), _truth(200, rate=70.0, seed=3)
    times = slow.timestamps.copy()
    times[30] = fast.timestamps[np.abs(fast.timestamps - times[30]).argmin()]  # one exact match
    slow = Trajectory(times, slow.poses)
    estimate, truth = (fast, slow) if swap else (slow, fast)
    evo_truth, evo_estimate = _evo_pair(tmp_path, estimate, truth, max_dt)
    found_estimate, found_truth = associate(*_both_loaded(tmp_path), max_dt)
    np.testing.assert_allclose(found_estimate.positions, evo_estimate.positions_xyz, atol=TOLERANCE)
    np.testing.assert_allclose(found_truth.positions, evo_truth.positions_xyz, atol=TOLERANCE)


@pytest.mark.parametrize("scale", [1.0, 0.01, 250.0])
def test_umeyama_finds_the_transform_that_was_applied(scale: float) -> None:
    # Proves that a similarity is recovered from points it moved, a flat set included. Oracle: the similarity.
    rng = np.random.default_rng(4)
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([3.0, -2.0, 9.0])
    for flatness in (1.0, 0.0):
        source = rng.normal(size=(30, 3)) * [1.0, 2.0, flatness]
        found = umeyama(source, scale * source @ rotation.T + translation, with_scale=True)
        error = max(np.abs(found.rotation - rotation).max(), abs(found.scale / scale - 1))
        assert error < 1e-12, f"flatness {flatness}: off by {error}"
        np.testing.assert_allclose(found.translation, translation, atol=1e-10)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_a_mirrored_set_is_not_mirrored_back() -> None:
    # Proves that the result is a rotation even where a reflection would fit better. Oracle: the determinant, and that
    # no rotation near by fits better.
    rng = np.random.default_rng(5)
    source = rng.normal(size=(20, 3))
    target = source * [1.0, 1.0, -1.0]
    found = umeyama(source, target)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    best = np.sum((found.points(source) - target) ** 2)
    for turn in Rotation.from_rotvec(rng.normal(scale=0.05, size=(50, 3))).as_matrix():
        other = source @ (turn @ found.rotation).T
        assert np.sum((other - other.mean(0) - target + target.mean(0)) ** 2) >= best


def test_a_still_camera_has_an_ate() -> None:
    # Proves that positions that all coincide (rotation and scale undetermined) give finite results. Oracle: the
    # spread of the other set.
    truth = _truth(20)
    still = Trajectory(truth.timestamps, np.tile(np.eye(4), (20, 1, 1)))
    spread = np.sqrt(((truth.positions - truth.positions.mean(0)) ** 2).sum(1).mean())
    for kind in ("se3", "sim3"):
        assert absolute_error(still, truth, kind).statistics.rmse == pytest.approx(spread)
        assert absolute_error(still, still, kind).statistics.rmse == pytest.approx(0.0, abs=1e-12)


def test_rotation_angle_is_accurate_at_both_ends() -> None:
    # Proves the angle from 1e-9 rad to pi - 1e-9. Oracle: scipy's rotation vectors.
    angles = np.array([0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-9])
    axis = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    found = rotation_angle(Rotation.from_rotvec(angles[:, None] * axis).as_matrix())
    assert np.abs(found - angles).max() < 1e-14 * 100, f"off by {np.abs(found - angles)}"


def test_a_delta_beyond_the_trajectory_gives_no_pairs() -> None:
    # Proves that a delta longer than the trajectory is nothing to measure, not a crash; the report has None for it.
    truth = _truth(10)
    report = evaluate_trajectory(truth, truth, delta=50)
    assert report.relative.translation_statistics.count == 0
    assert report.to_dict()["rpe_translation_m"]["rmse"] is None


def test_two_published_truths_of_a_clip(shared_data: Path) -> None:
    # Proves association, alignment and ATE on real files: COLMAP against the published poses, 5.0 cm after Sim(3).
    estimate = Trajectory.load_tum(shared_data / "redkitchen" / "reference-colmap.txt")
    truth = open_sequence(shared_data / "redkitchen").ground_truth()
    assert truth is not None
    report = evaluate_trajectory(estimate, truth)
    assert report.matched == 500
    assert report.sim3.statistics.rmse == pytest.approx(0.0502, abs=1e-4)
