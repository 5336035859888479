"""Maps without depth where most of what is seen is far away: their scale stays, and no frame is lost.

Exact truth: the renderer's poses.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from recorded_run import ROLES, SETTINGS
from vggtgeo.models.classical import NoDepth

from vggtgeo.geometry import rigid
from vggtgeo.simulation import Sensor, SyntheticSequence
from vggtgeo.simulation.scene import finish
from vggtgeo.simulation.sequence import camera_of
from vggtgeo.simulation.shapes import Look, SceneBuilder
from vggtgeo.simulation.trajectories import HandheldMotion, Walk
from vggtgeo.slam.run import run
from vggtgeo.slam.state import Slam

FAR = 300.0
"""Metres to what is seen around."""
WALK = Walk(
    way=np.array([[-1.0, 0.0, 1.5], [1.5, 0.0, 1.5], [3.0, 0.0, 1.5], [3.0, 3.0, 1.5], [0.0, 3.0, 1.5]]),
    targets=np.array([[-0.5, -3.0, 1.3], [2.0, -3.0, 1.3], [6.0, 0.5, 1.5], [3.0, 9.0, 1.5], [-3.0, 9.0, 1.5]]),
    corner=0.5,
    turn=0.5,
)
"""Along the house, and then away from it towards the view."""


POSTS = (
    *((-1.2, -1.7), (0.2, -1.9), (1.6, -1.8), (3.4, -1.6), (4.8, -1.0), (5.2, 0.4), (5.0, 1.7), (5.6, 2.9)),
    *((5.0, 4.4), (4.0, 5.2), (2.6, 5.6), (1.4, 5.1), (0.2, 5.7), (-1.2, 5.0), (-2.2, 3.6), (-2.6, 2.0)),
)
"""Where something stands that is near enough to show how far the camera went."""


@cache
def _terrace() -> SyntheticSequence:
    build = SceneBuilder(0)
    for number in range(12):
        angle = number * np.pi / 6
        along = FAR * 0.54 * np.array([-np.sin(angle), np.cos(angle), 0.0])
        corner = FAR * np.array([np.cos(angle), np.sin(angle), 0.0]) + along / 2 - [0.0, 0.0, 0.3 * FAR]
        build.rectangle(corner, -along, (0.0, 0.0, 0.6 * FAR), Look(f"painting:{number}", None, emission=0.8))
    build.rectangle((-3.0, -3.0, 0.0), (9.0, 0.0, 0.0), (0.0, 9.0, 0.0), Look("rug", 1.3, emission=0.5))
    for number in range(4):
        build.rectangle((3.0 - 1.5 * number, -2.5, 0.0), (-1.5, 0.0, 0.0), (0.0, 0.0, 3.0), _poster(number + 8))
    for number, (x, y) in enumerate(POSTS):
        build.box((x, y, 0.0), (0.5, 0.5, 1.6), _poster(number))
    scene = finish(build, "terrace", ambient=0.3, texel=3.0)
    motion = replace(HandheldMotion.along(WALK, 0), speed=0.8)
    return SyntheticSequence(scene, motion, camera_of((320, 240)), Sensor(), 1, 4.0, 0, has_depth=False)


def _poster(number: int) -> Look:
    return Look(f"poster:{number}", None, emission=0.8)


def terrace(frames: int, rate: float = 4.0) -> SyntheticSequence:
    """The first frames of a walk, `rate` a second, at 0.8 m a second; it turns a quarter at each corner."""
    return replace(_terrace(), count=frames, rate=rate)


FREE_ROLES = replace(ROLES, depth=NoDepth())
FRAMES = 24


@pytest.fixture(scope="module")
def walked() -> Slam:
    """The state after a walk that turns from a wall to a view."""
    return deque(run(terrace(FRAMES), FREE_ROLES, SETTINGS), maxlen=1).pop()


def test_a_turn_towards_a_far_view_keeps_the_scale(walked: Slam) -> None:
    """From the wall to the view, where four fifths of the points are 300 m away, a step of the map stays in proportion
    to the true one to within 5 %, and a turn right to within 0.3 degrees. Oracle: the renderer's poses.
    """
    true = rigid.invert(terrace(FRAMES).ground_truth().poses)
    scales, turns = [], []
    for before, after in pairwise(walked.keyframes):
        moved, expected = after.pose @ rigid.invert(before.pose), true[after.frame] @ rigid.invert(true[before.frame])
        scales.append(np.linalg.norm(moved[:3, 3]) / np.linalg.norm(expected[:3, 3]))
        turns.append(np.degrees(rigid.angle_between(moved, expected)))
    assert len(scales) > 10
    assert np.ptp(scales) < 0.05 * np.median(scales), f"steps of the map over true ones: {np.round(scales, 3)}"
    assert max(turns) < 0.3, f"turns are {max(turns):.2f} degrees off"


def test_far_points_place_frames(walked: Slam) -> None:
    """Every frame has a pose, and keyframes know points whose depth is not determined. Oracle: what was rendered."""
    assert all(record.tracked for record in walked.frames if record.frame >= 2)
    slots = walked.keyframes[-2].points
    far = np.isfinite(slots.inverse_depth) & ~slots.determined
    assert np.count_nonzero(far) > 50
    assert np.median(slots.inverse_depth[far]) < 0.05
