"""Velocity of the camera at each frame and keyframe, from the poses of the frames before and after."""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import lie
from vggtgeo.slam.global_map.carried_poses import carried_poses
from vggtgeo.slam.state import Slam

MAX_GAP = 3.0
"""Largest time to a neighbouring frame for a velocity, in usual intervals."""


def camera_motions(slam: Slam, room: int) -> np.ndarray:
    """Return the velocity of the camera at each keyframe, float64 [room, 6], see `frame_motions`; zero beyond the
    keyframes.
    """
    motions = np.zeros((room, lie.TANGENT))
    row_of = {record.frame: row for row, record in enumerate(slam.frames)}
    there = [(place, row_of[k.frame]) for place, k in enumerate(slam.keyframes) if k.frame in row_of]
    if there:
        places, rows = np.array(there).T
        motions[places] = frame_motions(slam)[rows]
    return motions


def frame_motions(slam: Slam) -> np.ndarray:
    """Return the velocity of the camera at each frame, float64 [n, 6]: the tangent of world -> camera a second.

    Units of the map, then radians. From the frames before and after; zero without them.
    """
    times, poses = carried_poses(slam)
    if len(times) < 2:
        return np.zeros((len(times), lie.TANGENT))
    rows = np.arange(len(times))
    tracked = np.array([record.tracked for record in slam.frames])
    near = lambda other: tracked[other] & (np.abs(times[other] - times) <= MAX_GAP * frame_interval(slam))
    before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(times) - 1)
    # A missing neighbour is replaced by the frame itself: a one-sided difference, or none.
    before, after = np.where(near(before), before, rows), np.where(near(after), after, rows)
    seconds = (times[after] - times[before])[:, None]
    still = np.zeros((len(times), lie.TANGENT))
    return np.divide(lie.steps(poses[before], poses[after]), seconds, out=still, where=seconds > 0)


def frame_interval(slam: Slam) -> float:
    """Return the median time between frames, s; 0 for fewer than two."""
    times = np.array([record.timestamp for record in slam.frames])
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0
