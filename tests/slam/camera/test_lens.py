"""The lens of a camera that nobody calibrated is found, and taken out of the map. Truth: what pixels were bent by."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from changed import changed
from distorted_sequence import WINDOW, Bent, adjusted, bent
from recorded_run import ROLES, SETTINGS, recorded_run
from reported import raises
from vggtgeo.models.classical import NoDepth, SiftMatcher

import vggtgeo as vg
from vggtgeo.datasets.views import SequenceView
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry import pinhole
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.camera.lens import RADIAL, FoundLens, can_undistort, find_lens, largest_shift
from vggtgeo.slam.global_map import global_adjustment
from vggtgeo.slam.global_map.global_adjustment import _apply_lens, undistorted
from vggtgeo.slam.known_map import as_map, entered
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracking_state import SeenPoints
from vggtgeo.slam.verdict.claim import Claim
from vggtgeo.slam.verdict.corner_recorder import FrameCorners
from vggtgeo.slam.verdict.judge import aligned


def packed(window: vg.data.SimulatedWindow, camera: vg.cameras.Intrinsics | None = None) -> tuple[Any, Any, Any]:
    """The problem of the window with one focal length, by default the true one."""
    f, _, cx, cy = window.intrinsics
    given = camera or vg.cameras.Intrinsics(np.array([f, cx, cy]), shared_focal=True)
    return vg.pack(window.observations, window.start, given, 1.0 / window.observations.depth_mean)


def found_in(window: vg.data.SimulatedWindow, focal: float) -> FoundLens:
    """Adjusted as a pinhole that begins `focal` times too long, as a guess does, then sought."""
    _, _, cx, cy = window.intrinsics
    guess = np.array([focal * window.intrinsics[0], cx, cy])
    problem, state, _ = packed(
        window, vg.cameras.Intrinsics(guess, shared_focal=True, prior_sigma=np.full(3, 0.3 * guess[0]))
    )
    size = (round(2 * cy + 1), round(2 * cx + 1))
    found = find_lens(problem, adjusted(problem, state), size, adjusted)
    assert found is not None
    return found


@pytest.mark.long
def test_a_lens_is_found() -> None:
    # Proves that distortion that nobody told is found beside a focal length that begins 10 % off, and how far it moves
    # pixels. Oracle: the lens that the pixels were bent with.
    window = vg.simulate_window(seed=0, **WINDOW)
    found = found_in(bent(window, -0.15, 0.05), 1.1)
    f, _, cx, cy = found.camera.intrinsics
    assert f == pytest.approx(window.intrinsics[0], rel=0.01)
    assert found.is_significant, f"gain {found.gain:.4f}, needed {found.needed:.4f}, {found.camera}"
    corner = np.hypot(cx, cy) / f
    drawn = lambda k1, k2, r: f * r * (k1 * r**2 + k2 * r**4)
    inside = np.linspace(0, 0.7 * corner, 20)
    k1, k2, *tangential = found.camera.distortion
    assert np.abs(drawn(k1, k2, inside) - drawn(-0.15, 0.05, inside)).max() < 1.5
    assert tangential == [0.0, 0.0]
    assert found.warp == pytest.approx(np.abs(drawn(k1, k2, np.linspace(0, corner * 1.07, 50))).max(), rel=0.3)


@pytest.mark.long
def test_the_lens_is_that_of_an_adjustment_with_its_camera() -> None:
    # Proves the search over adjustments of a pinhole, and the noise of undistorted pixels. Oracle: `solve` with the
    # lens among its unknowns.
    window = bent(vg.simulate_window(seed=0, **WINDOW), -0.15, 0.05)
    _, _, cx, cy = window.intrinsics
    guess = np.array([1.1 * window.intrinsics[0], cx, cy, 0.0, 0.0, 0.0, 0.0])
    intrinsics = vg.cameras.Intrinsics(
        guess,
        model=vg.cameras.RadialTangential,
        shared_focal=True,
        prior_sigma=np.array([*np.full(3, 0.3 * guess[0]), RADIAL, RADIAL, 1.0, 1.0]),
        fixed=np.arange(7) > 4,
    )
    problem, start, _ = vg.pack(window.observations, window.start, intrinsics, 1.0 / window.observations.depth_mean)
    expected = np.asarray(adjusted(problem, start).intrinsics)
    camera = found_in(window, 1.1).camera
    radius = np.linspace(0, np.hypot(cx, cy) / expected[0], 50)
    drawn = lambda f, k1, k2: f * radius * (1 + k1 * radius**2 + k2 * radius**4)
    error = np.abs(drawn(camera.intrinsics[0], *camera.distortion[:2]) - drawn(expected[0], *expected[3:5])).max()
    assert error < 0.1, f"{error:.3f} px, {camera}, {expected}"


@pytest.mark.long
def test_no_lens_is_found_where_there_is_none() -> None:
    # Proves that noise alone is no lens, in six windows. Oracle: the pinhole that they were drawn with.
    found = [found_in(vg.simulate_window(seed=seed, **WINDOW), 1.1) for seed in range(6)]
    assert not any(each.is_significant for each in found), [(each.gain, each.needed, each.camera) for each in found]


def test_an_adjustment_that_ends_in_no_camera_is_no_lens() -> None:
    # Proves that a focal length below zero, or NaN, as a solver may end with, does not end the run. Oracle: the rule.
    problem, state, _ = packed(vg.simulate_window(3, 12, 0))
    for focal in (-1.0, float("nan")):
        ends_at = lambda _, state, f=focal: eqx.tree_at(lambda s: s.intrinsics, state, state.intrinsics.at[0].set(f))
        assert find_lens(problem, state, (480, 640), ends_at) is None


def test_few_keyframes_tell_no_lens() -> None:
    # Proves that as many keyframes as the camera has parameters explain any lens, and so tell none. Oracle: the count.
    unmoved = lambda _, state: state
    problems = [packed(vg.simulate_window(keyframes, 12, 0)) for keyframes in (5, 7)]
    few, enough = (find_lens(problem, state, (480, 640), unmoved) for problem, state, _ in problems)
    assert few.needed == float("inf")
    assert enough.needed < float("inf")


def test_a_lens_that_does_not_pay_is_not_taken() -> None:
    # Proves that the state stays where matches do not ask for a lens, or it folds the image. Oracle: the state.
    slam = merge_pending_window(recorded_run().states[-1])
    adjustment, state = slam.window.solved
    left_out = FoundLens(LENS, state, gain=0.0, needed=float("inf"), warp=40.0)
    for found in (None, left_out, replace(left_out, warp=float("inf"))):
        assert _apply_lens(slam, adjustment, found) is slam


def test_a_lens_that_folds_the_image_is_none() -> None:
    # Proves that coefficients that draw a farther point nearer, as bad data may ask for, move pixels without a bound,
    # and that a lens that keeps their order does not. Oracle: k1 = -1 folds at a radius of 0.58 focal lengths, and the
    # corner's is 0.71; 0.1 moves the farthest corner by what solves the cubic.
    assert largest_shift(replace(LENS, distortion=(-1.0, 0.0, 0.0, 0.0))) == float("inf")
    # k1 = -0.35 folds between the sides, 0.57 away, and the corners: a picture without its corners. There the
    # derivative of r - 0.35 r^3 is zero, and the shift 0.35 r^3.
    folded = largest_shift(replace(LENS, distortion=(-0.35, 0.0, 0.0, 0.0)))
    assert folded == pytest.approx(LENS.intrinsics[0] * 0.35 * (1 / np.sqrt(1.05)) ** 3, rel=0.02)
    f, _, cx, cy = LENS.intrinsics
    corner = np.hypot(max(cx, 160 - cx), max(cy, 120 - cy)) / f
    (ideal,) = [root.real for root in np.roots([0.1, 0.0, 1.0, -corner]) if abs(root.imag) < 1e-9]
    shift = largest_shift(replace(LENS, distortion=(0.1, 0.0, 0.0, 0.0)))
    assert shift == pytest.approx(f * (corner - ideal), rel=0.02)


LENS = Camera((140.0, 140.0, 80.0, 58.0), 160, 120, (-0.2, 0.03, 0.0, 0.0), known=False)


@cache
def run_of_room() -> Slam:
    *_, slam = vg.run(vg.simulate("room", 6, size=(160, 120), rate=10.0), ROLES, SETTINGS)
    return merge_pending_window(slam)


def redrawn(pixels: np.ndarray) -> np.ndarray:
    """Ideal pixels as the lens draws them: by this package's model, not by OpenCV."""
    rays = pinhole.rays(pixels.reshape(-1, 2), LENS.intrinsics)
    padded = np.pad(rays, ((0, -len(rays) % 2048), (0, 0)), constant_values=1.0).reshape(-1, 2048, 3)
    drawn = [np.asarray(_drawn(jnp.asarray(some))) for some in padded]
    return np.concatenate([np.zeros((0, 2)), *drawn])[: len(rays)].reshape(pixels.shape)


@jax.jit
def _drawn(rays: jax.Array) -> jax.Array:
    """Pixels of as many rays each time: compiled once."""
    return jax.vmap(vg.cameras.RadialTangential(jnp.asarray([*LENS.intrinsics, *LENS.distortion])).project)(rays)


def test_the_map_is_as_an_ideal_camera_sees_it() -> None:
    # Proves that key points (those of frames, too), matches, segments and samples are where the ideal camera has them,
    # pictures and depth are resampled alike, and poses and depths stay. Oracle: each goes back through the lens to its
    # old place.
    before = run_of_room()
    kept = SeenPoints(np.arange(2, dtype=np.int32), np.array([[20.0, 15.0], [140.0, 90.0]], np.float32))
    before = changed(before, "tracker", frames=(*before.frames[:-1], replace(before.frames[-1], seen=kept)))
    assert can_undistort(before.keyframes)
    after = undistorted(before, LENS)
    assert after.camera.lens is LENS
    np.testing.assert_array_equal(after.intrinsics, LENS.intrinsics)
    for old, new in zip(before.keyframes, after.keyframes, strict=True):
        for name in ("points", "samples"):
            moved, place = getattr(new, name), getattr(old, name)
            np.testing.assert_allclose(redrawn(moved.pixels), place.pixels, atol=1e-3)
            np.testing.assert_array_equal(moved.inverse_depth, place.inverse_depth)
        np.testing.assert_allclose(redrawn(new.features.pixels), old.features.pixels, atol=1e-3)
        ends = new.lines.segments.endpoints
        np.testing.assert_allclose(redrawn(ends), old.lines.segments.endpoints, atol=1e-3)
        np.testing.assert_array_equal(new.pose, old.pose)
        grid = np.stack(np.meshgrid(np.arange(60, 100), np.arange(40, 80)), -1).reshape(-1, 2)
        columns, rows = np.rint(redrawn(grid.astype(float))).astype(int).T
        np.testing.assert_array_equal(new.depth[grid[:, 1], grid[:, 0]], old.depth[rows, columns])
        off = new.image[grid[:, 1], grid[:, 0]].astype(int) - old.image[rows, columns]
        assert np.median(np.abs(off)) <= 8
    for old_pair, new_pair in zip(before.map.pairs, after.map.pairs, strict=True):
        np.testing.assert_allclose(redrawn(new_pair.points.pixels_i), old_pair.points.pixels_i, atol=1e-3)
        np.testing.assert_allclose(redrawn(new_pair.points.pixels_j), old_pair.points.pixels_j, atol=1e-3)
    last = after.frames[-1].seen
    np.testing.assert_allclose(redrawn(last.pixels), kept.pixels, atol=1e-3)


def test_a_second_lens_is_added_to_the_first() -> None:
    """A map of images that were undistorted keeps the first lens in that of the images as read. Oracle: both."""
    slam = changed(run_of_room(), "camera", lens=LENS, self_calibrated=True)
    rest = replace(LENS, intrinsics=(141.0, 141.0, 81.0, 57.0), distortion=(0.02, 0.01, 0.0, 0.0))
    lens = undistorted(slam, rest).camera.lens
    pixels = np.random.default_rng(0).uniform((0, 0), (160, 120), (200, 2))
    off = np.abs(lens.distorted(pixels) - LENS.distorted(rest.distorted(pixels))).max()
    assert off < 0.1, f"{off:.3f} px"


@pytest.mark.parametrize(("before", "self_calibrated"), [(None, False), (LENS, True), (LENS, False)])
def test_a_known_lens_stays(before: Camera | None, self_calibrated: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last adjustment searches a lens that is unknown, or a first guess of self-calibration. Oracle: the rule."""
    slam = merge_pending_window(recorded_run().states[-1])
    adjustment, state = slam.window.solved
    sigma = np.full(4, 100.0)
    slam = slam.with_map(metric=False).with_camera(lens=before, self_calibrated=self_calibrated, sigma=sigma)
    rest = FoundLens(replace(LENS, distortion=(0.02, 0.0, 0.0, 0.0)), state, gain=1.0, needed=0.0, warp=5.0)
    monkeypatch.setattr(global_adjustment, "find_lens", lambda *_: rest)
    monkeypatch.setattr(global_adjustment, "undistorted", lambda slam, lens: slam.with_camera(lens=lens))
    monkeypatch.setattr(global_adjustment, "_try_pixel_aspect", lambda done: done)
    after = global_adjustment._try_camera(global_adjustment._Solved(slam, adjustment, state), [], SETTINGS)
    assert after.camera.lens == (rest.camera if before is None or self_calibrated else before)


def test_corners_of_the_verdict_go_through_the_lens() -> None:
    # Proves that the corner tracks show the same camera as the map. Oracle: what it is given, back through the lens.
    slam = undistorted(run_of_room(), LENS)
    seen = np.array([[10.0, 10.0], [80.0, 58.0], [150.0, 100.0]], np.float32)
    nothing = np.zeros(3, np.float32)
    noted = [FrameCorners(r.frame, r.timestamp, np.arange(3), seen, nothing) for r in slam.frames]
    given = aligned(slam, Claim.of(slam), noted)
    assert len(given) == len(slam.frames) > 1
    np.testing.assert_allclose(redrawn(given[0].pixels), seen, atol=1e-3)


def test_descriptors_that_hold_their_image_keep_the_pinhole() -> None:
    # Proves that a map whose matcher looks at images of its own is left alone. Oracle: the rule.
    slam = run_of_room()
    first = slam.keyframes[0]
    other = replace(first, features=replace(first.features, descriptors=object()))
    assert not can_undistort((other, *slam.keyframes[1:]))


def test_a_camera_that_was_found_goes_with_its_map() -> None:
    # Proves that a map of a guessed camera takes the calibration that its run found, and refuses another, such as what
    # the run began with; and that a run in the map holds what was found. Oracle: the rule.
    guess = np.array([160.0, 160.0, 79.5, 59.5])
    known = as_map(undistorted(run_of_room(), LENS))
    known = changed(known, "camera", given=guess, sigma=np.full(4, 48.0))
    within = entered(known, replace(LENS, known=True), SiftMatcher())
    assert within.camera.self_calibrated
    assert within.camera.given.tolist() == list(LENS.intrinsics)
    with raises("140.0", "80.0", "58.0"):
        entered(known, Camera((160.0, 160.0, 79.5, 59.5), 160, 120), SiftMatcher())


@pytest.mark.slow  # three minutes: first passes, a run, its last adjustment
def test_a_phone_without_calibration_from_end_to_end(tmp_path: Path) -> None:
    # Proves that images alone, of an unknown lens that bends corners by many pixels, give its focal length to 3 %, a
    # word on it, a summary that says it, and a map that frames as they were drawn are found in again. Oracle: the lens
    # that drew them.
    office = vg.simulate("office", 60, size=(320, 240), rate=10.0)
    frames = Bent(office, replace(office.camera, distortion=(-0.08, -0.02, 0.0, 0.0)))
    result = vg.reconstruct(SequenceView(frames, frames.camera, has_depth=False), options=vg.RunOptions(dense="none"))
    lens = result.summary["lens"]
    assert lens["fx"] == pytest.approx(frames.lens.intrinsics[0], rel=0.03)
    assert result.intrinsics[0] == pytest.approx(lens["fx"], rel=0.01)
    assert any(note.startswith("self-calibration") and "k1" in note for note in result.summary["notes"])
    assert evaluate_trajectory(result.trajectory, frames.ground_truth()).sim3.statistics.rmse < 0.02
    result.save_map(tmp_path / "office.map")
    known = vg.load_map(tmp_path / "office.map")
    assert known.camera.lens is not None
    fixed = replace(vg.SlamSettings(), keyframes=replace(vg.SlamSettings().keyframes, localise_only=True))
    *_, again = vg.run(frames, vg.Roles(depth=NoDepth()), fixed, start=20, end=24, known_map=known)
    places = [np.linalg.inv(again.pose(record))[:3, 3] for record in again.frames if record.tracked]
    assert len(places) >= 3
    own = result.trajectory.poses[20:24, :3, 3][-len(places) :]
    span = np.linalg.norm(np.ptp(result.trajectory.poses[:, :3, 3], axis=0))
    assert np.linalg.norm(np.array(places) - own, axis=1).max() < 0.02 * span
