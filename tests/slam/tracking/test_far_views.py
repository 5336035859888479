"""Maps without depth where most of what is seen is far away: their scale stays, and no frame is lost.

Exact truth: the renderer's poses.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from recorded_run import ROLES, SETTINGS
from terrace import terrace
from vggtgeo.models.classical import NoDepth

from vggtgeo.geometry import rigid
from vggtgeo.slam.run import run
from vggtgeo.slam.state import Slam

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
