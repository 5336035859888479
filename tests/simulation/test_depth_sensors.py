"""Depth cameras that triangulate, against their own formulas."""

from dataclasses import replace

import numpy as np
import pytest

from vggtgeo.simulation.sensor import KINECT, NATIVE_WIDTH, STEREO, DisparitySensor

CLEAN = DisparitySensor(focal_baseline=40.0, noise=0.0, grain=0.0, step=0.0, window=0.0, far=100.0)


def _measured(sensor: DisparitySensor, depth: np.ndarray) -> np.ndarray:
    return sensor.measured(depth, np.random.default_rng(0))


def test_a_sensor_without_errors_measures_exact_depth() -> None:
    # Proves that depth survives the way through disparity, and that nothing stays nothing. Oracle: the depth given.
    depth = np.full((30, 40), 2.0)
    depth[3, 4] = np.nan
    np.testing.assert_allclose(_measured(CLEAN, depth), depth, rtol=1e-6)


@pytest.mark.parametrize("grain", [0.0, 4.0])
def test_noise_grows_with_the_square_of_depth(grain: float) -> None:
    # Proves `dz = z^2 / (f b) dd`. Oracle: the formula, at two depths.
    sensor = replace(CLEAN, noise=0.05, grain=grain)
    for z in (1.0, 3.0):
        spread = np.std(_measured(sensor, np.full((200, NATIVE_WIDTH), z)))
        assert abs(spread / (z**2 / 40.0 * 0.05) - 1) < 0.1, (z, spread)


def test_depth_is_quantised_in_disparity() -> None:
    # Proves the steps of depth. Oracle: whole multiples of the step, no farther than half of it.
    depth = np.tile(np.linspace(1, 4, NATIVE_WIDTH), (4, 1))
    disparity = 40.0 / _measured(replace(CLEAN, step=0.125), depth)
    seen = np.isfinite(disparity)
    np.testing.assert_allclose(disparity[seen] / 0.125, np.rint(disparity[seen] / 0.125), atol=1e-3)
    assert np.abs(disparity - 40.0 / depth)[seen].max() <= 0.0626


def test_a_nearer_surface_casts_a_shadow_as_wide_as_the_difference_of_disparity() -> None:
    # Proves the holes beside edges: on one side alone, of `f b (1 / near - 1 / far)` pixels. Oracle: the formula.
    depth = np.full((10, NATIVE_WIDTH), 4.0)
    depth[:, 300:400] = 1.0
    hole = np.isnan(_measured(CLEAN, depth))
    assert not hole[:, 300:].any()
    assert abs(hole[5].sum() - 30) <= 1, hole[5].sum()
    assert hole[5, 299]


def test_a_window_makes_nearer_surfaces_larger() -> None:
    # Proves the bleeding of edges: by half a window on both sides, of the nearer surface's depth. Oracle: the window.
    depth = np.full((60, NATIVE_WIDTH), 4.0)
    depth[:, 300:400] = 1.0
    measured = _measured(replace(CLEAN, window=8.0), depth)
    assert np.flatnonzero(np.isclose(measured[30], 1.0))[[0, -1]].tolist() == [296, 403]


@pytest.mark.parametrize("sensor", [KINECT, STEREO])
def test_nothing_is_measured_too_far_away(sensor: DisparitySensor) -> None:
    # Proves the reach of the sensors. Oracle: a wall beyond it, and one before.
    assert np.isnan(_measured(sensor, np.full((20, 30), 1.5 * sensor.far))).all()
    near = _measured(sensor, np.full((20, 30), 2.0))
    assert np.isfinite(near).all()
    assert 0 < np.abs(near - 2.0).max() < 0.08
