"""A camera that nobody gave: the motion to the other side, with near and far exchanged, against that of the map."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from matched_slam import matched_slam
from scipy.spatial.transform import Rotation
from test_trust_sensor_drift import K

from vggtgeo.geometry import rigid
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust import reversal
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.reversal import check_reversal
from vggtgeo.slam.trust.zoom import Unknowns, matches_among

KEYFRAMES, POINTS = 6, 150


@cache
def _pan() -> Slam:
    """A camera that nobody gave turns by 20 degrees, and moves by 0.5 m, before things 2.5 to 3 m away."""
    rng = np.random.default_rng(0)
    shares = np.linspace(0, 1, KEYFRAMES)
    world = rng.uniform((-1.2, -1, 2.5), (1.7, 1, 3), (POINTS, 3))
    poses = np.tile(np.eye(4), (KEYFRAMES, 1, 1))
    for pose, share in zip(poses, shares, strict=True):
        pose[:3, :3] = Rotation.from_rotvec([0.0, -np.radians(20) * (share - 0.5), 0.0]).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ (0.5 * (share - 0.5), 0.02 * np.sin(9 * share), -0.05 * share)
    return matched_slam(world, poses)


@cache
def _wrong_way() -> Slam:
    """The same pictures in a map that began with the other motion, and was adjusted to all matches from there."""
    slam = _pan()
    seen = matches_among(slam, np.arange(KEYFRAMES))
    assert seen is not None
    poses = np.array([keyframe.pose for keyframe in slam.keyframes])
    start = reversal._reversed_poses(seen, poses), np.zeros(KEYFRAMES), reversal._reversed_depth(seen.depth)
    found = reversal._adjusted(seen, Unknowns(*start))
    inverse = np.exp(found.depth).reshape(KEYFRAMES, POINTS)
    keyframes = tuple(
        replace(keyframe, pose=pose, points=replace(keyframe.points, inverse_depth=own))
        for keyframe, pose, own in zip(slam.keyframes, found.poses, inverse, strict=True)
    )
    return replace(
        slam,
        map=replace(slam.map, keyframes=keyframes),
        camera=replace(slam.camera, intrinsics=K * np.exp([*found.focal[:2], 0.0, 0.0])),
    )


def test_map_of_the_wrong_motion_is_told() -> None:
    """Oracle: the true motion, from which the map's goes to the other side."""
    true, wrong = (
        rigid.invert(np.array([keyframe.pose for keyframe in slam.keyframes]))[:, :3, 3]
        for slam in (_pan(), _wrong_way())
    )
    assert np.dot(true[-1] - true[0], wrong[-1] - wrong[0]) < 0
    (finding,) = check_reversal(_wrong_way())
    assert finding.level == "degraded"
    assert "near and far exchanged" in finding.text
    assert any("near and far exchanged" in reason for reason in judge(_wrong_way()).reasons)


def test_map_of_the_right_motion_is_not() -> None:
    """Oracle: the poses are the true ones."""
    assert not check_reversal(_pan())


def test_reversal_that_comes_back_is_no_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: it ends where the map is, so that both explain the matches alike."""
    monkeypatch.setattr(reversal, "_reversed_poses", lambda _, poses: poses)
    monkeypatch.setattr(reversal, "_reversed_depth", lambda depth: depth)
    assert not check_reversal(_pan())


def test_given_camera_or_measured_depth_is_not_asked() -> None:
    """Their focal length, or their depth, tells the two apart."""
    slam = _wrong_way()
    assert not check_reversal(replace(slam, camera=replace(slam.camera, sigma=np.ones(4))))
    assert not check_reversal(replace(slam, map=replace(slam.map, metric=True)))


def test_few_keyframes_say_nothing() -> None:
    """Three are less than what is asked for."""
    slam = _pan()
    assert not check_reversal(
        replace(slam, map=replace(slam.map, keyframes=slam.keyframes[:3], pairs=slam.map.pairs[:2]))
    )
