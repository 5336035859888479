"""Dense depth of keyframes: what slots and neighbouring views make of it."""

import numpy as np
import pytest
from posed_keyframes import INTRINSICS, SIZE, small_keyframe
from scipy.ndimage import gaussian_filter

from vggtgeo.mapping.keyframe_depth import fused_depths, optimised_depth
from vggtgeo.slam.sparse_map.keyframe import Slots

WALL = 3.0
"""Metres from every camera: all look along one axis, side by side."""


def smooth_error(rng: np.random.Generator) -> np.ndarray:
    """Relative errors of 5 %, alike over some thirty pixels."""
    field = gaussian_filter(rng.normal(size=SIZE), 30.0, mode="wrap")
    return 0.05 * field / field.std()


def test_views_of_one_wall_are_averaged() -> None:
    # Proves that errors which differ from view to view shrink to less than a half, that a hole stays a hole, and that
    # what stands before the wall in one view keeps its depth. Oracle: the depth without errors.
    rng = np.random.default_rng(0)
    depths = [WALL * np.exp(smooth_error(rng)) for _ in range(12)]
    depths[6][:10, :10] = np.nan
    depths[6][80:100, 60:100] = 1.5
    fused = fused_depths([small_keyframe(number, depth) for number, depth in enumerate(depths)], INTRINSICS)
    found = fused[6]
    wall = np.abs(depths[6] - 1.5) > 0.01
    wall[72:108, 52:108] = False  # the cells at the box's rim
    error = lambda depth: np.sqrt(np.nanmean((depth[wall] - WALL) ** 2))
    assert error(found) < 0.5 * error(depths[6])
    np.testing.assert_array_equal(np.isnan(found), np.isnan(depths[6]))
    np.testing.assert_allclose(found[84:96, 64:96], 1.5, rtol=0.015)


def test_slots_correct_what_is_around_them() -> None:
    # Proves that a keyframe alone takes the depth of its slots, also against a given depth. Oracle: the true wall.
    rng = np.random.default_rng(1)
    prior = (WALL * np.exp(smooth_error(rng))).astype(np.float16).astype(np.float64)
    rows, columns = np.mgrid[4 : SIZE[0] : 8, 4 : SIZE[1] : 8].reshape(2, -1)
    count, inverse = len(rows), 1 / prior[rows, columns]
    pixels = np.column_stack([columns, rows]).astype(np.float64)
    one = np.ones(count)
    slots = Slots(pixels, np.full(count, 1 / WALL), inverse, 0.05 * inverse, one, one, np.nan * one)
    error = lambda depth: np.sqrt(np.mean((depth - WALL) ** 2))
    assert error(optimised_depth(small_keyframe(0, prior, slots), prior.astype(np.float32))) < 0.5 * error(prior)
    assert error(optimised_depth(small_keyframe(0, prior, slots), np.full(SIZE, 1.02 * WALL, np.float32))) < 0.01 * WALL


def test_a_keyframe_without_depth_has_none() -> None:
    # Proves the mixture of keyframes with and without depth. Oracle: None and the depth given.
    fused = fused_depths([small_keyframe(0, np.full(SIZE, np.nan)), small_keyframe(1, np.full(SIZE, WALL))], INTRINSICS)
    assert fused[0] is None
    assert fused[1] == pytest.approx(WALL, rel=1e-3)
