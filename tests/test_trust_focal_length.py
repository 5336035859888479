"""A camera that nobody gave: is its focal length known?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matched_slam import matched_slam
from scipy.spatial.transform import Rotation
from test_trust_sensor_drift import K

from vggtgeo.geometry import rigid
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.focal_length import check_focal_length, focal_sigma
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.reversal import _adjusted
from vggtgeo.slam.trust.zoom import Unknowns, matches_among

KEYFRAMES, POINTS = 6, 150


def _glide(degrees: float, seed: int = 1) -> Slam:
    """A camera goes 1 m straight on into a room, and turns by so much on the way."""
    rng = np.random.default_rng(0)
    world = rng.uniform((-2, -1.5, 3), (2, 1.5, 6), (POINTS, 3))
    poses = np.tile(np.eye(4), (KEYFRAMES, 1, 1))
    for pose, share in zip(poses, np.linspace(0, 1, KEYFRAMES), strict=True):
        turned = np.radians(degrees) * np.array([0.3 * np.sin(6 * share), share - 0.5, 0.0])
        pose[:3, :3] = Rotation.from_rotvec(turned).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ (0.05 * share, 0.0, share)
    return matched_slam(world, poses, seed)


def test_stretched_world_gives_the_same_pictures() -> None:
    """Why it is so: without a turn, a world, a path and a focal length stretched by 2.7 leave all pixels in place."""
    pose, points = _glide(0.0).keyframes[-1].pose.copy(), np.array([[0.5, -0.3, 4.0], [-1.0, 0.8, 5.0]])
    far, longer = points * [1, 1, 2.7], K * [2.7, 2.7, 1, 1]
    stretched = pose.copy()
    stretched[2, 3] *= 2.7
    np.testing.assert_allclose(rigid.project(far, stretched, longer), rigid.project(points, pose, K), atol=1e-9)


def test_camera_that_goes_straight_on_is_told() -> None:
    """Oracle: the focal length of such a map is free, see above."""
    (finding,) = check_focal_length(_glide(0.0))
    assert finding.level == "degraded"
    assert "focal length" in finding.text
    assert any("hardly determine its focal length" in reason for reason in judge(_glide(0.0)).reasons)


def test_camera_that_turns_is_not() -> None:
    """Proves that what is said of the focal length is what it is. Oracle: its spread over twelve draws of the noise."""
    slam, rows = _glide(30.0), np.arange(KEYFRAMES)
    assert not check_focal_length(slam)
    found = []
    for seed in range(12):
        seen = matches_among(_glide(30.0, seed), rows)
        assert seen is not None
        start = Unknowns(np.array([one.pose for one in slam.keyframes]), np.zeros(KEYFRAMES), seen.depth)
        found.append(_adjusted(seen, start).focal[0])
    sigma = focal_sigma(slam, rows)
    assert sigma is not None
    assert 0.5 < np.std(found, ddof=1) / sigma < 2.0, f"spread {np.std(found, ddof=1):.5f}, stated {sigma:.5f}"


@pytest.mark.parametrize("known", [{"metric": True}, {"intrinsics_sigma": np.ones(4)}])
def test_given_camera_or_measured_depth_is_not_asked(known: dict) -> None:
    """What was given is asked by others (`calibration.py`)."""
    assert not check_focal_length(replace(_glide(0.0), **known))
