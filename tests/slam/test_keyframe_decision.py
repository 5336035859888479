"""The decision of a keyframe, from known poses and numbers of inliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_state import keyframe

from vggtgeo.geometry import rigid
from vggtgeo.slam.keyframe_decision import nearest_keyframe, needs_keyframe, view_change
from vggtgeo.slam.settings.groups import KeyframeSettings

SETTINGS = KeyframeSettings(keyframe_distance=0.2, keyframe_angle=float(np.deg2rad(10.0)))
ENOUGH = 50


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
        frame, reference = pose(metres, degrees) @ world, world
        found = needs_keyframe(frame, reference, inliers, SETTINGS)
        assert found == expected, view_change(frame, reference, SETTINGS)


def test_view_change_is_the_larger_share() -> None:
    """The change of a view is the larger of distance and angle as shares of their limits. Oracle: the shares."""
    assert view_change(pose(0.1, 2.0), pose(), SETTINGS) == pytest.approx(0.5)
    assert view_change(pose(0.1, 8.0), pose(), SETTINGS) == pytest.approx(0.8)


def test_the_nearest_keyframe_is_one_that_spares_another() -> None:
    """Of several keyframes the one with the smallest view change is given, and none where each is beyond a limit.
    Oracle: the shares of the limits.
    """
    near = [replace(keyframe(k), number=k, pose=pose(*at)) for k, at in enumerate([(0.15, 0), (0.01, 9), (0.1, 1)])]
    best = nearest_keyframe(pose(), near, SETTINGS)
    assert best is not None
    assert best.number == 2
    away = [replace(keyframe(k), number=k, pose=pose(*at)) for k, at in enumerate([(0.25, 0), (0.01, 12)])]
    assert nearest_keyframe(pose(), away, SETTINGS) is None
    assert nearest_keyframe(pose(), [], SETTINGS) is None
