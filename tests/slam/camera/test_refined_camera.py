"""A given camera is refined where the data ask for it and it pays, and only there. Exact truth: a simulated window."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from distorted_sequence import WINDOW, adjusted, bent

import vggtgeo as vg
from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.given_camera import RefinedCamera, estimate_with_map, refine_given_camera
from vggtgeo.slam.camera.pairwise_intrinsics import CameraPair, _Points, pairwise_intrinsics
from vggtgeo.slam.camera.pixel_aspect import aspect_prior

HELD = 1e-6
"""Relative standard deviation of a camera that is held, as in the pipeline."""


def pairs(window: vg.data.SimulatedWindow) -> list[CameraPair]:
    """Every edge of the window, depths as the prior has them."""
    seen, poses = window.observations, rigid.to_matrix(window.start)
    found = []
    for number, (host, target) in enumerate(seen.edges):
        rows = seen.point_edge == number
        landmark = seen.point_landmark[rows]
        relative = poses[target] @ rigid.invert(poses[host])
        depth = 1.0 / seen.depth_mean[landmark]
        found.append(CameraPair(seen.pixel[landmark], seen.point_target[rows], depth, relative, int(min(host, target))))
    return found


def trial(window: vg.data.SimulatedWindow, given: np.ndarray) -> RefinedCamera:
    """Adjusted with `given` held, then tried."""
    held = vg.cameras.Intrinsics(window.intrinsics, prior_mean=given, prior_sigma=np.full(4, HELD * given[0]))
    problem, initial, _ = window.pack(intrinsics=held)
    start = eqx.tree_at(lambda state: state.intrinsics, initial, jnp.asarray(given))
    found = refine_given_camera(pairs(window), problem, adjusted(problem, start), adjusted)
    assert found is not None
    return found


@pytest.mark.parametrize("seed", range(2))
def test_a_wrong_camera_is_mended(seed: int) -> None:
    # Proves that a focal length 2 % off is found to a half of that, that it is seen to pay, and that the shape of the
    # pixels and a right principal point stay. Oracle: the camera that the window was drawn with.
    window = vg.simulate_window(seed=seed, **WINDOW)
    wrong = window.intrinsics * np.array([1.02, 1.02, 1.0, 1.0])
    found = trial(window, wrong)
    assert found.is_significant, f"gain {found.gain:.4f}, needed {found.needed:.4f}, wanted {found.wanted}"
    left = np.abs(found.wanted - window.intrinsics)
    assert left[0] < 0.01 * window.intrinsics[0], found.wanted
    assert left[2:].max() < 1.0, found.wanted
    assert found.wanted[0] / found.wanted[1] == pytest.approx(wrong[0] / wrong[1], rel=1e-6)
    assert found.change == pytest.approx(np.abs(found.wanted - wrong).max() / wrong[0], rel=1e-4)


@pytest.mark.long
def test_a_right_camera_is_left_alone() -> None:
    # Proves that noise alone does not pay: of six windows with the true camera, none moves it. Oracle: the truth.
    trials = [trial(window, window.intrinsics) for window in (vg.simulate_window(seed=s, **WINDOW) for s in range(6))]
    assert not any(each.is_significant for each in trials), [(each.gain, each.needed, each.wanted) for each in trials]


def test_what_the_pairs_do_not_tell_stays() -> None:
    # Proves that a camera that is seen worse than the prior is not moved: few points, bad depth. Oracle: the given one.
    window = vg.simulate_window(8, 12, 0, noise=3.0, depth_error=0.3, start_error=0.01, seed=1)
    given = window.intrinsics * np.array([1.01, 1.01, 1.0, 1.0])
    found = trial(window, given)
    np.testing.assert_allclose(found.wanted, given, rtol=1e-6)
    assert not found.is_significant


def with_the_map(window: vg.data.SimulatedWindow, factor: float) -> RefinedCamera:
    """The camera estimated with a map without measured depth, given a focal length that is `factor` of the true one."""
    given = window.intrinsics * np.array([factor, factor, 1.0, 1.0])
    cameras = vg.cameras.Intrinsics(given, prior_sigma=np.full(4, HELD * given[0]))
    seen = replace(window.observations, depth_weight=np.full(len(window.observations.host), 1e-6))
    terms = (aspect_prior(given),)
    problem, initial, _ = vg.pack(seen, window.start, cameras, 1.0 / window.observations.depth_mean, terms=terms)
    return estimate_with_map(problem, adjusted(problem, initial), adjusted)[1]


@pytest.mark.parametrize("factor", [1.02, 0.97])
def test_a_wrong_camera_is_mended_without_measured_depth(factor: float) -> None:
    # Proves that a focal length 2 or 3 % off is found to 1 %, and that it pays. Oracle: the camera of the window.
    window = vg.simulate_window(seed=0, **WINDOW)
    found = with_the_map(window, factor)
    assert found.is_significant, f"gain {found.gain:.4f}, needed {found.needed:.4f}, wanted {found.wanted}"
    np.testing.assert_allclose(found.wanted[:2], window.intrinsics[:2], rtol=0.01)
    np.testing.assert_allclose(found.wanted[2:], window.intrinsics[2:], atol=1.5)


@pytest.mark.long
def test_a_right_camera_is_left_alone_without_measured_depth() -> None:
    # Proves that noise alone does not pay there either. Oracle: the truth, in six windows.
    found = [with_the_map(vg.simulate_window(seed=seed, **WINDOW), 1.0) for seed in range(6)]
    assert not any(each.is_significant for each in found), [(each.gain, each.needed, each.wanted) for each in found]


def test_a_lens_that_nobody_told_of_is_no_focal_length() -> None:
    # Proves that distortion is found as such, k1 to a tenth, and the focal length beside it to 1 %. Oracle: the lens
    # that the pixels were bent with.
    window = vg.simulate_window(seed=3, **WINDOW)
    estimate = pairwise_intrinsics(pairs(bent(window, -0.2, 0.0)), window.intrinsics)
    assert estimate.value[3] == pytest.approx(-0.2, abs=0.02)
    assert abs(estimate.value[0]) < 0.01
    assert estimate.value[3] < -10 * estimate.sigma[3]


def test_the_derivatives_of_pairs_are_those_of_their_residuals() -> None:
    # Proves that a pixel's derivatives by the pose and by the camera, lens included, are right. Oracle: central
    # differences. The lens is weak enough for its inverse, four iterations, to be one.
    points = _Points.of(pairs(vg.simulate_window(seed=4, **WINDOW))[:3])
    intrinsics, camera, poses = np.array([500.0, 490.0, 320.0, 240.0]), np.array([0.02, 3.0, -4.0, -0.01]), points.given
    exact = points.linearized(poses, camera, intrinsics)
    residuals = lambda poses, camera: points.linearized(poses, camera, intrinsics)[..., -1]
    moved = lambda step: residuals(rigid.moved(poses, np.tile(step, (3, 1))), camera)
    changed = lambda step: residuals(poses, camera + step)
    for column, step in enumerate(1e-5 * np.eye(6)):
        np.testing.assert_allclose(exact[:, :, column], (moved(step) - moved(-step)) / 2e-5, rtol=1e-4, atol=1e-3)
    for column, size in enumerate((1e-5, 1e-2, 1e-2, 1e-5)):
        step = size * np.eye(4)[column]
        expected = (changed(step) - changed(-step)) / (2 * size)
        np.testing.assert_allclose(exact[:, :, 6 + column], expected, rtol=1e-4, atol=1e-3)
