"""Poses that leave the room for something that moves: what agreed with them before does not any more, and the reverse.

Beside the room's corners there are those of a board that moves by itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from trust_checks import found_by_sides
from witness import K, Walk, walk

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.evidence import FrameEvidence

TAKEN = 20


@pytest.fixture(scope="module")
def board() -> Walk:
    """What the camera would have seen of the board if it were what stands still."""
    return walk(seed=1, step=-0.06)


@pytest.fixture(scope="module")
def both(healthy: Walk, board: Walk) -> list[FrameEvidence]:
    """The corners of the room and of the board."""
    return [_joined(room, other) for room, other in zip(healthy.evidence, board.evidence, strict=True)]


@pytest.mark.parametrize("metric", [True, False])
def test_poses_that_a_board_takes_along_are_told(
    healthy: Walk, board: Walk, both: list[FrameEvidence], metric: bool
) -> None:
    """From one frame on the poses are those of the camera before the board."""
    poses = healthy.estimate.poses.copy()
    ahead = board.estimate.poses[TAKEN:] @ rigid.invert(board.estimate.poses[TAKEN - 1])
    poses[TAKEN:] = ahead @ poses[TAKEN - 1]
    found = found_by_sides(replace(healthy.with_poses(poses), metric=metric), both)
    assert [(finding.level, finding.start, finding.end) for finding in found] == [("degraded", TAKEN - 1, None)]


def test_poses_that_stay_with_the_room_are_not(healthy: Walk, both: list[FrameEvidence]) -> None:
    """Whether the board goes on, or stops and so agrees with them, too."""
    assert found_by_sides(healthy.estimate, both) == []
    poses = healthy.estimate.poses
    stopped = [_at_rest(frame, both[TAKEN], poses[row] @ rigid.invert(poses[TAKEN])) for row, frame in enumerate(both)]
    assert found_by_sides(healthy.estimate, [*both[:TAKEN], *stopped[TAKEN:]]) == []


def _joined(room: FrameEvidence, other: FrameEvidence) -> FrameEvidence:
    return replace(
        room,
        ids=np.concatenate([room.ids, other.ids + 10_000]),
        pixels=np.concatenate([room.pixels, other.pixels]),
        depth=np.concatenate([room.depth, other.depth]),
    )


def _at_rest(frame: FrameEvidence, there: FrameEvidence, motion: np.ndarray) -> FrameEvidence:
    """The board's corners of another frame, carried by the camera's motion since."""
    room, others = frame.ids < 10_000, there.ids >= 10_000
    points = rigid.unproject(there.pixels[others].astype(np.float64), 1.0 / there.depth[others], np.eye(4), K)
    ahead = points @ motion[:3, :3].T + motion[:3, 3]
    return replace(
        frame,
        ids=np.concatenate([frame.ids[room], there.ids[others]]),
        pixels=np.concatenate([frame.pixels[room], rigid.project(points, motion, K).astype(np.float32)]),
        depth=np.concatenate([frame.depth[room], ahead[:, 2].astype(np.float32)]),
    )
