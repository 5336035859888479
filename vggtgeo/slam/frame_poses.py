"""The pose of every frame, by the keyframe that it hangs on."""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.frame_refinement import by_both
from vggtgeo.slam.state import FramePose, Slam


def frame_poses(slam: Slam) -> tuple[np.ndarray, np.ndarray]:
    """Times [n] in s and poses [n, 4, 4], world -> camera, of all frames; of one without a pose the last known.

    A frame hangs on the keyframe it was tracked against. What the adjustment then changed between that keyframe and the
    next is shared out over the frames in between, in proportion to time, so that the path has no steps. What a second
    keyframe says of a frame is averaged with that (`frame_refinement.py`). The frame that a keyframe was made of has
    the keyframe's pose, whether it was tracked there (`arrival`) or began a piece of map.
    """
    poses = np.array([slam.pose(record) for record in slam.frames]).reshape(-1, 4, 4)
    times = np.array([record.timestamp for record in slam.frames])
    last = 0
    for row, record in enumerate(slam.frames):
        if not _made_its_keyframe(record):
            continue
        if record.arrival is not None:
            reference, tracked = record.arrival
            change = poses[row] @ rigid.invert(tracked @ slam.keyframes[reference].pose)
            between = [k for k in range(last + 1, row) if slam.frames[k].reference == reference]
            span = max(times[row] - times[last], 1e-9)
            for k in between:
                poses[k] = rigid.fraction(change, (times[k] - times[last]) / span) @ poses[k]
        last = row
    return times, by_both(slam, poses)


def _made_its_keyframe(record: FramePose) -> bool:
    """By its pose, exactly: keyframes of a known map may have the same number of a frame."""
    return record.tracked and np.array_equal(record.relative, np.eye(4))
