"""Errors of real cameras on simulated recordings, against renderings of the same moments."""

from dataclasses import replace

import numpy as np
import pytest

import vggtgeo as vg
from vggtgeo.geometry import rigid
from vggtgeo.simulation import IDEAL, SyntheticSequence
from vggtgeo.simulation.camera_errors import (
    auto_exposed,
    exposed,
    late_depth,
    late_truth,
    motion_field,
    vignetted,
)
from vggtgeo.simulation.degradations import Recording, camera_velocities

RATE = 25.0
INNER = (slice(8, -8), slice(8, -8))
"""Without the border, where pixels come from outside the image."""


def _walk(rate: float = RATE, count: int = 5, **errors: float) -> SyntheticSequence:
    return vg.simulate("room", count, 0, (200, 150), rate=rate, sensor=replace(IDEAL, **errors))


@pytest.fixture(scope="module")
def recording() -> Recording:
    sequence = _walk()
    return Recording(list(sequence.frames()), sequence.camera, sequence.ground_truth())


def _difference(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.nanmean(np.abs(first.astype(float) - second)[INNER]))


def test_the_motion_field_is_the_derivative_of_the_projection() -> None:
    # Proves the motion of pixels and depth. Oracle: finite differences of projected points, whatever their depth.
    rng = np.random.default_rng(0)
    intrinsics, velocity, step = (90.0, 80.0, 30.0, 20.0), rng.normal(0, 0.3, 6), 1e-5
    depth = rng.uniform(1, 4, (40, 60))
    field, nearing = motion_field(depth, velocity, intrinsics)
    v, u = np.mgrid[:40, :60].astype(float)
    points = np.stack([(u - 30) / 90 * depth, (v - 20) / 80 * depth, depth], -1)
    moved = points + step * (np.cross(velocity[3:], points) + velocity[:3])
    pixels = np.stack([90 * moved[..., 0] / moved[..., 2] + 30, 80 * moved[..., 1] / moved[..., 2] + 20], -1)
    np.testing.assert_allclose(field, (pixels - np.stack([u, v], -1)) / step, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(nearing, (moved[..., 2] - depth) / step, rtol=1e-3, atol=1e-4)


def test_the_velocity_is_the_motion_of_points_of_the_camera(recording: Recording) -> None:
    # Proves sign and frame of the velocity that the field takes. Oracle: a world point in the frames before and after.
    times = recording.truth.timestamps
    velocity = camera_velocities(times, recording.truth)[2]
    before, middle, after = (rigid.invert(recording.truth.poses[row]) for row in (1, 2, 3))
    point = np.array([3.0, 2.0, 1.0, 1.0])
    here = (middle @ point)[:3]
    moved = ((after - before) @ point)[:3] / (times[3] - times[1])
    np.testing.assert_allclose(np.cross(velocity[3:], here) + velocity[:3], moved, rtol=0.02, atol=2e-3)


@pytest.mark.parametrize("errors", [{"readout_time": 0.04}, {"exposure_time": 0.04}], ids=["rolling", "blur"])
def test_shutters_draw_what_the_renderer_draws(recording: Recording, errors: dict[str, float]) -> None:
    # Proves rolling shutter and motion blur. Oracle: renderings of each row's, and each instant's, own pose.
    true = _walk(**errors).frame(2).image
    drawn = exposed(recording, errors.get("readout_time", 0.0), errors.get("exposure_time", 0.0)).frames[2]
    sharp = _difference(recording.frames[2].image, true)
    assert _difference(drawn.image, true) < 0.5 * sharp, (_difference(drawn.image, true), sharp)
    np.testing.assert_array_equal(drawn.depth, recording.frames[2].depth)


def test_late_depth_is_that_of_the_moment_before(recording: Recording) -> None:
    # Proves the delay of depth and its sign. Oracle: depth rendered 10 ms before the frame.
    true = _walk(rate=100.0, count=15).frame(round(2 * 100 / RATE) - 1).depth
    # Medians: at the edges of surfaces depth jumps.
    off = lambda depth: float(np.median(np.abs(depth - true)[INNER]))
    here = off(recording.frames[2].depth)
    late, early = (off(late_depth(recording, seconds).frames[2].depth) for seconds in (0.01, -0.01))
    assert late < 0.4 * here < 0.3 * early, (late, here, early)


def test_late_truth_keeps_the_poses(recording: Recording) -> None:
    # Proves that the truth's clock alone moves. Oracle: the times before.
    late = late_truth(recording, 0.005).truth
    np.testing.assert_allclose(late.timestamps - recording.truth.timestamps, 0.005)
    np.testing.assert_array_equal(late.poses, recording.truth.poses)


def test_corners_are_dark_and_the_middle_is_not() -> None:
    # Proves the share of light that is missing. Oracle: a white image.
    sequence = _walk()
    white = replace(sequence.frame(0), image=np.full((91, 121, 3), 200, np.uint8), depth=None)
    image = vignetted(Recording([white], sequence.camera, sequence.ground_truth()), 0.3).frames[0].image
    assert image[45, 60, 0] == 200
    assert (image[0, 0, 0], image[-1, -1, 0]) == (140, 140)


def test_exposure_follows_the_brightness_with_a_lag() -> None:
    # Proves the control of exposure: a step of brightness by 2 is taken away, and not at once. Oracle: the known step.
    sequence = _walk()
    first = replace(sequence.frame(0), depth=None)
    levels = [60] * 10 + [120] * 40
    frames = [replace(first, index=k, image=np.full((9, 12, 3), v, np.uint8)) for k, v in enumerate(levels)]
    adapted = auto_exposed(Recording(frames, sequence.camera, sequence.ground_truth()), 1.0, 4.0).frames
    means = np.array([frame.image.mean() for frame in adapted])
    assert means[10] > 1.5 * means[9], means
    assert abs(means[-1] - means[9]) < 0.02 * means[9], means
