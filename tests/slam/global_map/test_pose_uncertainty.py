"""What a run says of the errors of its own poses."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from benchmark_modules import benchmark
from degenerate_scenes import packed, without_matches_of
from recorded_run import recorded_run
from reported import pattern
from scipy.spatial.transform import Rotation
from vggtgeo.solvers.conjugate_gradients import ConjugateGradients

import vggtgeo as vg
from vggtgeo.geometry import rigid
from vggtgeo.slam.global_map import global_adjustment, pose_uncertainty
from vggtgeo.slam.global_map.pose_uncertainty import keyframe_sigma, sparse_worst
from vggtgeo.slam.settings.groups import WindowSettings
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.tracking.pose_acceptance import tangent

loop = benchmark("simulated_loop")


def test_keyframes_have_the_deviations_of_their_covariances() -> None:
    """The worst direction of each pose, and never less than independent errors of weight 1 would give; oracle: the
    covariances, and numpy's eigenvalues.
    """
    problem, initial, _ = vg.simulate_window().pack()
    state = vg.solve(problem, initial).state
    known = vg.covariances(problem, state)
    sigma = keyframe_sigma(problem, state, 3)
    factor = max(float(known.variance_factor), 1.0)
    for column, part in enumerate((slice(0, 3), slice(3, 6))):
        worst = np.linalg.eigvalsh(np.asarray(known.poses)[:3, part, part])[:, -1]
        np.testing.assert_allclose(sigma[:, column], np.sqrt(factor * np.maximum(worst, 0.0)), rtol=1e-9, atol=1e-15)


def test_an_undetermined_keyframe_leaves_the_others_known() -> None:
    """NaN for the keyframe without matches alone; None if no free keyframe is determined. Oracle: the same problem with
    that keyframe fixed.
    """
    problem, state = packed(without_matches_of(2), at_truth=True, fixed=True)
    found = keyframe_sigma(problem, state, 3)
    held = eqx.tree_at(lambda p: p.fixed_pose, problem, problem.fixed_pose.at[2].set(True))
    expected = keyframe_sigma(held, state, 3)
    assert np.isnan(found[2]).all()
    np.testing.assert_allclose(found[:2], expected[:2], rtol=1e-9, atol=1e-15)
    alone = eqx.tree_at(lambda p: p.fixed_pose, problem, problem.fixed_pose.at[1].set(True))
    assert keyframe_sigma(alone, state, 3) is None


def test_a_sparse_factor_gives_the_same_deviations() -> None:
    """Of a ring of keyframes with surfaces, whose information has no band, and of one that is held; oracle: the
    covariances by a dense matrix.
    """
    window, surfaces = loop.simulate_loop(30, points=10, reach=2)
    problem, state, _ = window.pack(terms=(surfaces,))
    known = vg.covariances(problem, state)
    asked = np.array([0, 3, 16, 29])
    worst, factor = sparse_worst(problem, state, asked)
    assert factor == pytest.approx(float(known.variance_factor), rel=1e-9)
    for column, part in enumerate((slice(0, 3), slice(3, 6))):
        expected = np.linalg.eigvalsh(np.asarray(known.poses)[asked, part, part])[:, -1]
        np.testing.assert_allclose(worst[:, column], expected, rtol=1e-6, atol=1e-15)
    # All ties to one keyframe taken away: nothing determines it, and that is said, not raised.
    alone, _, _ = window.pack()
    unseen = alone.with_term(alone.terms["points"].reweighted(0.0 * alone.terms["points"].weight))
    assert sparse_worst(unseen, state, np.array([16]))[0].max() > 1e3 * worst.max()


def test_a_large_graph_without_a_band_is_asked_in_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keyframes between those that are asked get what lies between them. Oracle: the dense covariances."""
    window, surfaces = loop.simulate_loop(30, points=10, reach=2)
    problem, state, _ = window.pack(terms=(surfaces,))
    exact = keyframe_sigma(problem, state, 30)
    monkeypatch.setattr(pose_uncertainty, "DENSE_KEYFRAMES", 20)
    monkeypatch.setattr(pose_uncertainty, "choose_reduced_solver", lambda problem: ConjugateGradients())
    monkeypatch.setattr(pose_uncertainty, "SPREAD", 15)
    found = keyframe_sigma(problem, state, 30)
    np.testing.assert_allclose(found, exact, rtol=0.25, atol=1e-12)


@pytest.mark.long
def test_true_errors_lie_within_what_is_stated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """95 % of the poses are within three standard deviations of the truth, relative to the first, and the deviations
    are not so large that this says nothing. Oracle: the renderer's poses; the folder has the same numbers.
    """
    monkeypatch.setattr(pose_uncertainty, "DEPTH_SCALE", 0.0)  # the renderer's depth has no factor of its own,
    monkeypatch.setattr(pose_uncertainty, "FOCAL_SIGMA", 0.0)  # its camera is the one that is given,
    monkeypatch.setattr(pose_uncertainty, "CENTRE", 0.0)  # with its middle in that of the images,
    monkeypatch.setattr(pose_uncertainty, "MOMENT", 0.0)  # and its images are of one moment
    small = SlamSettings(window=WindowSettings(size=4, point_slots=96, line_slots=48))
    result = vg.reconstruct(vg.simulate("room", 24, size=(320, 240), rate=6.0), settings=small)
    stated = result.uncertainty
    against_first = lambda poses: rigid.invert(poses[0])[None] @ poses
    found, true = against_first(result.trajectory.poses), against_first(result.record.truth.poses)
    off = np.array([tangent(rigid.invert(one) @ other) for one, other in zip(found, true, strict=True)])
    for error, sigma in ((off[:, :3], stated.translation), (off[:, 3:], stated.rotation)):
        size = np.linalg.norm(error, axis=1)
        assert np.mean(size <= 3 * sigma) >= 0.95
        assert np.median(sigma) < 10 * np.median(size)
    # What an image's moment leaves open grows with the speed of turning.
    monkeypatch.setattr(pose_uncertainty, "MOMENT", 0.01)
    moving = result.uncertainty
    poses, times = result.record.truth.poses, stated.timestamps
    rate = Rotation.from_matrix((rigid.invert(poses[:-2]) @ poses[2:])[:, :3, :3]).magnitude() / (
        times[2:] - times[:-2]
    )
    added = np.sqrt(moving.rotation**2 - stated.rotation**2)[1:-1]
    np.testing.assert_allclose(added, 0.01 * rate, atol=1e-4)
    assert np.all(moving.translation > stated.translation)
    monkeypatch.setattr(pose_uncertainty, "MOMENT", 0.0)
    # What a focal length leaves open grows with the angle to the first pose.
    monkeypatch.setattr(pose_uncertainty, "FOCAL_SIGMA", 0.01)
    calibrated = result.uncertainty
    angles = Rotation.from_matrix(true[:, :3, :3]).magnitude()
    np.testing.assert_allclose(np.sqrt(calibrated.rotation**2 - stated.rotation**2), 0.01 * angles, atol=1e-4)
    monkeypatch.setattr(pose_uncertainty, "FOCAL_SIGMA", 0.0)
    # A principal point that nobody has measured turns all cameras alike, and with the first one the whole path.
    monkeypatch.setattr(pose_uncertainty, "CENTRE", 0.01)
    nominal, focal = result.uncertainty, result.record.slam.intrinsics[0]
    turn, distance = 0.01 * 320 / focal, np.linalg.norm(found[:, :3, 3], axis=1)
    np.testing.assert_allclose(np.sqrt(nominal.translation**2 - stated.translation**2), turn * distance, atol=1e-4)
    np.testing.assert_allclose(
        np.sqrt(nominal.rotation**2 - stated.rotation**2), turn * 2 * np.sin(angles / 2), atol=1e-4
    )
    given = result.record.slam.camera.given + [0.0, 0.0, 3.0, 0.0]
    moved = result.record.slam.with_camera(given=given)
    measured = pose_uncertainty.frame_uncertainty(moved)
    np.testing.assert_allclose(measured.translation, stated.translation)
    monkeypatch.setattr(pose_uncertainty, "CENTRE", 0.0)
    result.save(tmp_path / "run")
    again = vg.Result.load(tmp_path / "run").uncertainty
    for read, written in zip(again, stated, strict=True):
        np.testing.assert_allclose(read, written, atol=1e-6)


def test_keyframes_without_an_uncertainty_are_named() -> None:
    """The last adjustment notes how many keyframes are unknown and their frames, all of them if there is no uncertainty
    at all, and nothing if it is whole. Oracle: rows made NaN by hand.
    """
    slam = recorded_run().slam
    slam = slam.with_map(keyframes=tuple(replace(slam.keyframes[0], frame=n) for n in range(8)))
    sigma = np.full((8, 2), 0.01)
    noted = lambda values: global_adjustment._uncertainty_notes(slam.with_map(pose_sigma=values))
    assert noted(sigma) == []
    assert len(noted(None)) == 1
    sigma[[2, 3, 4, 6]] = np.nan
    (note,) = noted(sigma)
    assert all(re.search(pattern(part), note) for part in (4, 8, "2 to 4", "6 to 6"))
