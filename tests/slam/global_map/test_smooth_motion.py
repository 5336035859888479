"""Places of frames between keyframes, smoothed; oracles: the path that was planted, and the energy of its points."""

from __future__ import annotations

import numpy as np
import pytest
from posed_keyframes import INTRINSICS

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.slam.global_map.smooth_motion import smoothed

COUNT = 40
TIMES = np.arange(COUNT) / 10.0
NEAR, FAR = 2.0, 300.0
"""Distances of points, metres."""


def path() -> np.ndarray:
    """A curved walk of 4 m that turns by half a radian, world -> camera, with a jerk of 3 cm at frame 30."""
    centres = np.stack([TIMES, 0.2 * np.sin(TIMES), 0.05 * TIMES**2], 1)
    centres[30] += [0.0, 0.03, 0.0]
    poses = np.array([rigid.exponential(np.array([0, 0, 0, 0, angle, 0])) for angle in np.linspace(0, 0.5, COUNT)])
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], centres)
    return poses


def information(rng: np.random.Generator, distance: float, noise: float = 0.3) -> np.ndarray:
    """Information [6, 6] of 80 points at about this distance, seen with `noise` pixels."""
    points = np.concatenate([rng.uniform(-0.3, 0.3, (80, 2)), np.ones((80, 1))], 1) * rng.uniform(1, 1.5, (80, 1))
    rows = np.concatenate(pinhole.projection_rows(distance * points, INTRINSICS), 1)
    return rows @ rows.T / noise**2


def drawn(rng: np.random.Generator, known: np.ndarray) -> np.ndarray:
    """An error with this information."""
    return np.linalg.solve(np.linalg.cholesky(known).T, rng.standard_normal(6))


@pytest.fixture
def walked() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True poses, estimated poses, their information, and which are no keyframes: every fourth frame is one, without
    error; frames 10 to 15 see far points alone.
    """
    rng, true = np.random.default_rng(0), path()
    known = np.array([information(rng, FAR if 10 <= row < 16 else NEAR) for row in range(COUNT)])
    free = np.arange(COUNT) % 4 > 0
    errors = np.array([drawn(rng, one) for one in known]) * free[:, None]
    return true, rigid.moved(true, errors), known, free


def off(poses: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Errors of the camera centres, metres."""
    return np.linalg.norm(rigid.centres(poses) - rigid.centres(true), axis=1)


def test_far_views_come_to_where_the_motion_is_smooth(walked: tuple[np.ndarray, ...]) -> None:
    """Frames whose points leave decimetres open come to within 3 cm of the truth; those whose points are near stay
    within 1.5 cm, the one at the jerk, too; keyframes stay to the bit.
    """
    true, poses, known, free = walked
    found = smoothed(TIMES, poses, known, free, np.zeros(COUNT, int))
    far = free & (np.arange(COUNT) >= 10) & (np.arange(COUNT) < 16)
    before, after = off(poses, true), off(found, true)
    assert before[far].max() > 0.1
    assert after[far].max() < 0.03, after[far]
    assert after[free & ~far].max() < 0.015, after[free & ~far]
    np.testing.assert_array_equal(found[~free], poses[~free])


def test_the_rotation_follows_as_the_points_ask(walked: tuple[np.ndarray, ...]) -> None:
    """Of all rotations at its new place a frame has the one that its points prefer; oracle: their quadratic energy has
    no gradient there.
    """
    _, poses, known, free = walked
    found = smoothed(TIMES, poses, known, free, np.zeros(COUNT, int))
    for row in np.flatnonzero(free):
        motion = found[row] @ rigid.invert(poses[row])
        step = np.concatenate([motion[:3, 3], [motion[2, 1], motion[0, 2], motion[1, 0]]])
        scale = np.sqrt(np.diag(known[row])[3:])
        np.testing.assert_allclose((known[row] @ step)[3:] / scale, 0.0, atol=2e-2 * max(1.0, np.linalg.norm(step)))


def test_motions_of_different_maps_are_apart(walked: tuple[np.ndarray, ...]) -> None:
    """A lost frame keeps its pose; a frame of another submap, or after a pause, moves none of those before it."""
    _, poses, known, free = walked
    one = np.zeros(COUNT, int)
    lost = smoothed(TIMES, poses, known, free, np.where(np.arange(COUNT) == 13, -1, 0))
    np.testing.assert_array_equal(lost[13], poses[13])
    later = TIMES + np.where(np.arange(COUNT) < 18, 0.0, 10.0)
    # The same accelerations elsewhere: their deviation is that of the whole run.
    aside = poses.copy()
    aside[18:, :3, 3] -= aside[18:, :3, :3] @ [0.0, 0.5, 0.0]
    for times, label in ((TIMES, np.where(np.arange(COUNT) < 18, 0, 1)), (later, one)):
        found = [smoothed(times, given, known, free, label)[:18] for given in (poses, aside)]
        np.testing.assert_allclose(*found, atol=1e-9)
    found = [smoothed(TIMES, given, known, free, one)[:18] for given in (poses, aside)]
    assert np.abs(found[0] - found[1]).max() > 1e-3


def test_two_frames_have_no_acceleration(walked: tuple[np.ndarray, ...]) -> None:
    """With fewer than three frames, or none that may move, all poses stay."""
    _, poses, known, free = walked
    for count in (0, 1, 2):
        few = slice(0, count)
        kept = smoothed(TIMES[few], poses[few], known[few], free[few], np.zeros(count, int))
        np.testing.assert_array_equal(kept, poses[few])
    np.testing.assert_array_equal(smoothed(TIMES, poses, known, free & False, np.zeros(COUNT, int)), poses)
