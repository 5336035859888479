"""Keyframes of a camera that nobody gave, without depth, each matched with each, in the true map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_keyframe_depth import SIZE, keyframe
from test_trust_sensor_drift import K
from vggtgeo.models.roles import Features, PointMatches

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.sparse_map.covisibility import without_matches
from vggtgeo.slam.sparse_map.keyframe import Slots
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracker import FramePose, Tracker

GUESSED = np.array([0.3 * K[0], 0.3 * K[1], 10.0, 10.0])
NOISE = 0.5
"""Pixels."""


def matched_slam(world: np.ndarray, poses: np.ndarray, seed: int = 1) -> Slam:
    """world: float64 [m, 3], points that all keyframes see; poses: [n, 4, 4], world -> camera. seed: of
    the noise.
    """
    rng, points = np.random.default_rng(seed), len(world)
    found, unknown, one = [], np.full(points, np.nan), np.ones(points)
    for number, pose in enumerate(poses):
        pixels = rigid.project(world, pose, K) + rng.normal(0, NOISE, (points, 2))
        slots = Slots(pixels, 1.0 / (world @ pose[2, :3] + pose[2, 3]), unknown, unknown, one, one)
        made = replace(keyframe(number, np.ones(SIZE), slots), pose=pose)
        found.append(replace(made, features=Features(made.points.pixels, one)))
    pairs, rows = [], np.arange(points)
    for first in range(len(poses)):
        for second in range(first + 1, len(poses)):
            both = PointMatches(rows, rows, found[first].points.pixels, found[second].points.pixels, one)
            pairs.append(replace(without_matches(first, second), points=both))
    records = [FramePose(k.frame, k.timestamp, k.number, np.eye(4), True, points) for k in found]
    return Slam(
        map=Map(metric=False, keyframes=tuple(found), pairs=tuple(pairs)),
        camera=CameraEstimate(intrinsics=K, given=K, sigma=GUESSED),
        tracker=Tracker(frames=tuple(records)),
    )
