"""Errors of real cameras on simulated recordings, against renderings of the same moments, and formulas."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benchmark_modules import benchmark

import vggtgeo as vg
from vggtgeo.simulation import IDEAL, SyntheticSequence
from vggtgeo.simulation.degradations import Recording

errors_of = benchmark("camera_errors")
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
    field, nearing = errors_of.motion_field(depth, velocity, intrinsics)
    v, u = np.mgrid[:40, :60].astype(float)
    points = np.stack([(u - 30) / 90 * depth, (v - 20) / 80 * depth, depth], -1)
    moved = points + step * (np.cross(velocity[3:], points) + velocity[:3])
    pixels = np.stack([90 * moved[..., 0] / moved[..., 2] + 30, 80 * moved[..., 1] / moved[..., 2] + 20], -1)
    np.testing.assert_allclose(field, (pixels - np.stack([u, v], -1)) / step, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(nearing, (moved[..., 2] - depth) / step, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("errors", [{"readout_time": 0.04}, {"exposure_time": 0.04}], ids=["rolling", "blur"])
def test_shutters_draw_what_the_renderer_draws(recording: Recording, errors: dict[str, float]) -> None:
    # Proves rolling shutter and motion blur. Oracle: renderings of each row's, and each instant's, own pose.
    true = _walk(**errors).frame(2).image
    drawn = errors_of.exposed(recording, errors.get("readout_time", 0.0), errors.get("exposure_time", 0.0)).frames[2]
    sharp = _difference(recording.frames[2].image, true)
    assert _difference(drawn.image, true) < 0.5 * sharp, (_difference(drawn.image, true), sharp)
    np.testing.assert_array_equal(drawn.depth, recording.frames[2].depth)


def test_late_depth_is_that_of_the_moment_before(recording: Recording) -> None:
    # Proves the delay of depth and its sign. Oracle: depth rendered 10 ms before the frame.
    true = _walk(rate=100.0, count=15).frame(round(2 * 100 / RATE) - 1).depth
    # Medians: at the edges of surfaces depth jumps.
    off = lambda depth: float(np.median(np.abs(depth - true)[INNER]))
    here = off(recording.frames[2].depth)
    late, early = (off(errors_of.late_depth(recording, seconds).frames[2].depth) for seconds in (0.01, -0.01))
    assert late < 0.4 * here < 0.3 * early, (late, here, early)


def test_exposure_follows_the_brightness_with_a_lag() -> None:
    # Proves the control of exposure: a step of brightness by 2 is taken away, and not at once. Oracle: the known step.
    sequence = _walk()
    first = replace(sequence.frame(0), depth=None)
    levels = [60] * 10 + [120] * 40
    frames = [replace(first, index=k, image=np.full((9, 12, 3), v, np.uint8)) for k, v in enumerate(levels)]
    adapted = errors_of.auto_exposed(Recording(frames, sequence.camera, sequence.ground_truth()), 1.0, 4.0).frames
    means = np.array([frame.image.mean() for frame in adapted])
    assert means[10] > 1.5 * means[9], means
    assert abs(means[-1] - means[9]) < 0.02 * means[9], means


CLEAN = errors_of.DisparitySensor(focal_baseline=40.0, noise=0.0, grain=0.0, step=0.0, window=0.0, far=100.0)


def _measured(sensor: Any, depth: np.ndarray) -> np.ndarray:
    return sensor.measured(depth, np.random.default_rng(0))


@pytest.mark.parametrize("grain", [0.0, 4.0])
def test_noise_grows_with_the_square_of_depth(grain: float) -> None:
    # Proves `dz = z^2 / (f b) dd`. Oracle: the formula, at two depths.
    sensor = replace(CLEAN, noise=0.05, grain=grain)
    for z in (1.0, 3.0):
        spread = np.std(_measured(sensor, np.full((200, errors_of.NATIVE_WIDTH), z)))
        assert abs(spread / (z**2 / 40.0 * 0.05) - 1) < 0.1, (z, spread)


def test_a_nearer_surface_casts_a_shadow_as_wide_as_the_difference_of_disparity() -> None:
    # Proves the holes beside edges: on one side alone, of `f b (1 / near - 1 / far)` pixels. Oracle: the formula.
    depth = np.full((10, errors_of.NATIVE_WIDTH), 4.0)
    depth[:, 300:400] = 1.0
    hole = np.isnan(_measured(CLEAN, depth))
    assert not hole[:, 300:].any()
    assert abs(hole[5].sum() - 30) <= 1, hole[5].sum()
    assert hole[5, 299]
