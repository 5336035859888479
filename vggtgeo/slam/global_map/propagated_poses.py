"""Poses of all frames, moved with their reference keyframes, and the velocities of the camera by these poses."""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import lie, rigid
from vggtgeo.geometry.robust import POSE_GATE
from vggtgeo.slam.global_map.pose_uncertainty import SHARED_ERRORS
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.frame_refinement import by_both
from vggtgeo.slam.tracking.tracking_state import FramePose

GROSS = SHARED_ERRORS * POSE_GATE
"""Squared Mahalanobis distance between the tracked and the adjusted pose of a keyframe above which its tracking was an
outlier: its correction is then not distributed over the frames before it."""
MAX_GAP = 3.0
"""Largest time to a neighbouring frame for a velocity, in usual intervals."""


def propagated_poses(slam: Slam) -> tuple[np.ndarray, np.ndarray]:
    """Return times [n], s, and poses [n, 4, 4], world -> camera, of all frames; for a lost frame the last known pose.

    A frame is stored relative to its reference keyframe. The correction of the next keyframe relative to that reference
    is distributed over the frames between them in proportion to time, so that the path has no steps, unless the tracked
    pose of that keyframe was an outlier (`GROSS`) or by rays. Motions from a second keyframe are averaged in
    (`frame_refinement.py`). The frame of a keyframe has the keyframe's pose, whether it was tracked (`arrival`) or
    started a submap.
    """
    poses = np.array([slam.pose(record) for record in slam.frames]).reshape(-1, 4, 4)
    times = np.array([record.timestamp for record in slam.frames])
    factors = {(factor.first, factor.second): factor for factor in slam.map.odometry_factors}
    last = 0
    for row, record in enumerate(slam.frames):
        if not _made_its_keyframe(record):
            continue
        if record.arrival is not None:
            reference, tracked = record.arrival
            arrived = tracked @ slam.keyframes[reference].pose
            change = poses[row] @ rigid.invert(arrived)
            factor = factors.get((reference, record.reference))
            # By rays the length of its motion was a guess, which frames tracked by points do not share.
            apart = factor is not None and (
                factor.by_two_view or _is_gross(arrived, poses[row], factor if slam.metric else factor.of_free_length())
            )
            between = [] if apart else [k for k in range(last + 1, row) if slam.frames[k].reference == reference]
            for k in between:
                # Along the screw motion of the change, in proportion to time.
                share = (times[k] - times[last]) / (times[row] - times[last])
                poses[k] = rigid.fraction(change, share) @ poses[k]
        last = row
    return times, by_both(slam.map, slam.frames, poses)


def _is_gross(arrived: np.ndarray, adjusted: np.ndarray, factor: MeasuredRelativePose) -> bool:
    """Return whether an adjustment moved a keyframe [4, 4] beyond the uncertainty of its tracking."""
    off = lie.steps(arrived[None], adjusted[None])[0]
    return bool(off @ factor.information @ off > GROSS)


def _made_its_keyframe(record: FramePose) -> bool:
    """Return whether the frame became its reference keyframe.

    Decided by its relative pose: keyframes of a known map may have the same frame number.
    """
    return record.tracked and np.array_equal(record.relative, np.eye(4))


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
    times, poses = propagated_poses(slam)
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
