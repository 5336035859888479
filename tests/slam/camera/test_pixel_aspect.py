"""Pixels that are not square, of an uncalibrated camera, are found. Truth: what images were squeezed by."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from changed import changed
from distorted_sequence import WINDOW, adjusted, bent
from recorded_run import SETTINGS, recorded_run

import vggtgeo as vg
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.pixel_aspect import FoundAspect, find_aspect
from vggtgeo.slam.global_map import global_adjustment
from vggtgeo.slam.global_map.global_adjustment import adjust_all, shares_focal


def rolling(seed: int) -> vg.data.SimulatedWindow:
    """A window whose cameras roll by up to 17 degrees either way. On its arc, which is level, any stretch of heights
    is as good as any other: with it the focal length downwards is not known.
    """
    window = vg.simulate_window(seed=seed, **WINDOW)
    seen, start = window.observations, rigid.to_matrix(window.start)
    angles = np.random.default_rng(seed).uniform(-0.3, 0.3, len(start))
    turns = rigid.moved(np.tile(np.eye(4), (len(start), 1, 1)), np.outer(angles, np.eye(6)[5]))
    centre = window.intrinsics[2:]
    assert window.intrinsics[0] == window.intrinsics[1]
    turned = lambda pixels, of: np.einsum("nij,nj->ni", turns[of, :2, :2], pixels - centre) + centre
    target = seen.edges[seen.point_edge, 1]
    seen = replace(seen, pixel=turned(seen.pixel, seen.host), point_target=turned(seen.point_target, target))
    return replace(window, observations=seen, start=rigid.to_quaternion(turns @ start))


def as_square(window: vg.data.SimulatedWindow, squeeze: float) -> tuple[Problem, State]:
    """Adjusted with one focal length, which begins as that of the images before they were squeezed."""
    f, _, cx, cy = window.intrinsics
    guess = np.array([f, squeeze * cx, cy])
    depths = 1.0 / window.observations.depth_mean
    packed = vg.pack(
        window.observations,
        window.start,
        vg.cameras.Intrinsics(guess, shared_focal=True, prior_sigma=np.full(3, 0.3 * f)),
        depths,
    )
    return packed[0], adjusted(*packed[:2])


def found_in(window: vg.data.SimulatedWindow, squeeze: float) -> FoundAspect:
    found = find_aspect(*as_square(window, squeeze), adjusted)
    assert found is not None
    return found


def test_squeezed_images_have_two_focal_lengths() -> None:
    # Proves that both are found, of 16:9 shown as 4:3, and that they are seen to pay. Oracle: those that the window was
    # drawn with, resized.
    window, squeeze = rolling(1), 0.75
    found = found_in(bent(window, 0.0, 0.0, squeeze=squeeze), squeeze)
    assert found.is_significant, f"gain {found.gain:.4f}, needed {found.needed:.4f}, {found.state.intrinsics}"
    assert found.stretch == pytest.approx(np.log(squeeze), abs=0.005)
    fx, fy, cx, _ = window.intrinsics
    np.testing.assert_allclose(found.state.intrinsics[:2], [squeeze * fx, fy], rtol=0.01)
    assert float(found.state.intrinsics[2]) == pytest.approx((cx + 0.5) * squeeze - 0.5, abs=3.0)


@pytest.mark.long
def test_square_pixels_stay_square() -> None:
    # Proves that noise alone makes no second focal length, in six windows. Oracle: the one that they were drawn with.
    found = [found_in(rolling(seed), 1.0) for seed in range(6)]
    assert not any(each.is_significant for each in found), [(each.gain, each.needed, each.stretch) for each in found]


def test_a_level_path_tells_no_aspect() -> None:
    # Proves that a stretch that any stretch of the heights makes up for is not taken. Oracle: the gain of nothing.
    squeezed = bent(vg.simulate_window(seed=1, **WINDOW), 0.0, 0.0, squeeze=0.75)
    assert not found_in(squeezed, 0.75).is_significant


def test_what_ends_in_no_camera_is_none() -> None:
    # Proves that a focal length below zero, or NaN, as a solver may end with, does not end the run. Oracle: the rule.
    window = vg.simulate_window(3, 12, 0)
    f, _, cx, cy = window.intrinsics
    depths = 1.0 / window.observations.depth_mean
    guess = vg.cameras.Intrinsics(np.array([f, cx, cy]), shared_focal=True)
    problem, state, _ = vg.pack(window.observations, window.start, guess, depths)
    for focal in (-1.0, float("nan")):
        ends_at = lambda _, state, f=focal: eqx.tree_at(lambda s: s.intrinsics, state, state.intrinsics.at[1].set(f))
        assert find_aspect(problem, state, ends_at) is None


@pytest.mark.long
def test_the_last_adjustment_goes_on_with_both(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that what is found is taken, told, and kept by the rounds after it; and that a run begun with it needs no
    # trial. Oracle: the focal lengths that the trial gives.
    tried: list[Problem] = []

    def stretched(problem: Problem, state: State, solve: Any) -> FoundAspect | None:
        tried.append(problem)
        found = find_aspect(problem, state, lambda _, start: start)
        moved = eqx.tree_at(lambda s: s.intrinsics, found.state, found.state.intrinsics.at[1].multiply(1.2))
        return replace(found, state=moved, stretch=float(-np.log(1.2)), gain=1.0, needed=0.0)

    monkeypatch.setattr(global_adjustment, "find_aspect", stretched)
    monkeypatch.setattr(global_adjustment, "can_undistort", lambda slam: False)
    slam = recorded_run().states[-1]
    guess = replace(slam, camera=replace(slam.camera, sigma=np.full(4, 100.0), self_calibrated=False), pending=None)
    assert shares_focal(guess)
    done = adjust_all(guess, SETTINGS)
    fx, fy, *_ = done.intrinsics
    assert fy / fx == pytest.approx(1.2, rel=0.02)
    assert any("pixels that are not square" in note for note in done.notes)
    assert len(tried) == 1
    again = changed(guess, "camera", intrinsics=done.intrinsics, given=done.intrinsics, self_calibrated=True)
    assert not shares_focal(again)
    assert adjust_all(again, SETTINGS, uncertainty=False).map.pose_sigma is None
    assert done.map.pose_sigma is not None
    assert len(tried) == 1
