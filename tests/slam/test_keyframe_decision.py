"""The decision of a keyframe, from known poses and numbers of inliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_state import CAMERA, HEIGHT, WIDTH, keyframe, state

from vggtgeo.geometry import rigid
from vggtgeo.slam.keyframe_decision import (
    MAX_PARALLAX,
    MAX_SHIFT,
    MIN_OVERLAP,
    nearest_keyframe,
    needs_keyframe,
    view_change,
)
from vggtgeo.slam.settings.groups import KeyframeSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe

SETTINGS = KeyframeSettings(keyframe_distance=0.2, keyframe_angle=float(np.deg2rad(10.0)))
ENOUGH = 50
METRIC = state()
UNITLESS = METRIC.with_map(metric=False, keyframes=tuple(map(keyframe, range(3))))


def pose(metres: float = 0.0, degrees: float = 0.0) -> np.ndarray:
    """World -> camera of a camera so far along x, turned by so much about y."""
    to_world = np.eye(4)
    to_world[:3, :3] = Rotation.from_rotvec([0.0, np.deg2rad(degrees), 0.0]).as_matrix()
    to_world[0, 3] = metres
    return rigid.invert(to_world)


@pytest.mark.parametrize(
    ("metres", "degrees", "inliers", "expected"),
    [
        (0.0, 0.0, ENOUGH, False),
        (0.19, 9.0, ENOUGH, False),
        (0.21, 0.0, ENOUGH, True),
        (-0.21, 0.0, ENOUGH, True),
        (0.0, 11.0, ENOUGH, True),
        (0.0, -11.0, ENOUGH, True),
        (0.0, 0.0, ENOUGH - 1, True),
    ],
)
def test_distance_angle_and_inliers_decide_each_alone(
    metres: float, degrees: float, inliers: int, expected: bool
) -> None:
    """A frame becomes a keyframe beyond one limit, and not within all; the world's frame does not matter. Oracle: the
    limits, on either side of each.
    """
    for world in (np.eye(4), rigid.invert(pose(3.0, 70.0))):
        frame, reference = pose(metres, degrees) @ world, replace(keyframe(0), pose=world)
        found = needs_keyframe(METRIC, frame, reference, inliers, SETTINGS)
        assert found == expected, view_change(METRIC, frame, reference, SETTINGS)


def test_view_change_is_the_larger_share() -> None:
    """The change of a view is the larger of distance and angle as shares of their limits. Oracle: the shares."""
    reference = replace(keyframe(0), pose=pose())
    assert view_change(METRIC, pose(0.1, 2.0), reference, SETTINGS) == pytest.approx(0.5)
    assert view_change(METRIC, pose(0.1, 8.0), reference, SETTINGS) == pytest.approx(0.8)


def test_the_nearest_keyframe_is_one_that_spares_another() -> None:
    """Of several keyframes the one with the smallest view change is given, and none where each is beyond a limit.
    Oracle: the shares of the limits.
    """
    near = [replace(keyframe(k), number=k, pose=pose(*at)) for k, at in enumerate([(0.15, 0), (0.01, 9), (0.1, 1)])]
    best = nearest_keyframe(METRIC, pose(), near, SETTINGS)
    assert best.number == 2
    away = [replace(keyframe(k), number=k, pose=pose(*at)) for k, at in enumerate([(0.25, 0), (0.01, 12)])]
    assert nearest_keyframe(METRIC, pose(), away, SETTINGS) is None
    assert nearest_keyframe(METRIC, pose(), [], SETTINGS) is None


def spread(depth: float) -> Keyframe:
    """Return a keyframe with key points over its whole image, all at one depth (infinity: unknown)."""
    across, down = np.meshgrid(np.linspace(1, WIDTH - 1, 8), np.linspace(1, HEIGHT - 1, 8))
    pixels = np.stack([across.ravel(), down.ravel()], -1)
    made = keyframe(0)
    inverse = np.full(len(pixels), 1.0 / depth if np.isfinite(depth) else np.nan)
    exact = np.where(np.isfinite(inverse), 1e-6 * inverse, np.nan)
    return replace(made, points=replace(made.points, pixels=pixels, inverse_depth=inverse, estimate_sigma=exact))


@pytest.mark.parametrize("unit", [1.0, 100.0])
@pytest.mark.parametrize(("share", "expected"), [(0.9, False), (1.1, True)])
def test_without_a_unit_the_parallax_decides(unit: float, share: float, expected: bool) -> None:
    """The same angle between rays decides in any unit of length. Oracle: the angle at the image's centre."""
    moved = pose(share * unit * np.tan(MAX_PARALLAX))
    # So narrow a view of the middle that each point has the angle of the centre; it leaves no image.
    near = spread(unit)
    middle = CAMERA[2:] + 0.01 * (near.points.pixels - CAMERA[2:])
    near = replace(near, points=replace(near.points, pixels=middle))
    assert view_change(UNITLESS, moved, near, SETTINGS) == pytest.approx(share, abs=0.02)
    assert needs_keyframe(UNITLESS, moved, near, ENOUGH, SETTINGS) == expected


@pytest.mark.parametrize("depth", [2.0, np.inf])
def test_without_a_unit_the_overlap_decides_in_a_turn(depth: float) -> None:
    """Columns of key points that leave the image decide, also without depth. Oracle: the columns, without corners."""
    # Eight columns: two of them are a quarter, more than may leave.
    for columns, expected in ((1, False), (2, True)):
        edge = np.arctan2(CAMERA[2] - (WIDTH - 2) / 7 * (columns - 0.5), CAMERA[0])
        turned = pose(0.0, np.rad2deg(np.arctan2(CAMERA[2], CAMERA[0]) - edge))
        change = view_change(UNITLESS, turned, spread(depth), SETTINGS)
        assert change == pytest.approx(columns / 8 / (1 - MIN_OVERLAP), abs=0.2)
        assert needs_keyframe(UNITLESS, turned, spread(depth), ENOUGH, SETTINGS) == expected
    assert view_change(UNITLESS, pose(), spread(depth), SETTINGS) == 0.0


@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_without_a_unit_uncertain_depths_need_a_keyframe_sooner(unit: float) -> None:
    """A frame needs a keyframe where depth errors move points by more than a match's noise. Oracle: `f t sigma`."""
    moved = pose(0.02 * unit)
    for shift, expected in ((0.9 * MAX_SHIFT, False), (1.1 * MAX_SHIFT, True)):
        reference = spread(unit)
        sigma = np.full(len(reference.points.pixels), shift / (CAMERA[0] * 0.02 * unit))
        reference = replace(reference, points=replace(reference.points, estimate_sigma=sigma))
        assert needs_keyframe(UNITLESS, moved, reference, ENOUGH, SETTINGS) == expected
        assert view_change(UNITLESS, moved, reference, SETTINGS) == pytest.approx(shift / MAX_SHIFT)


def test_a_third_view_comes_early() -> None:
    """Of two keyframes a quarter of the limit is enough. Oracle: the share of the map with three."""
    moved, reference = pose(np.tan(0.5 * MAX_PARALLAX)), spread(1.0)
    two = UNITLESS.with_map(keyframes=UNITLESS.keyframes[:2])
    change = view_change(UNITLESS, moved, reference, SETTINGS)
    assert view_change(two, moved, reference, SETTINGS) == pytest.approx(4 * change)
