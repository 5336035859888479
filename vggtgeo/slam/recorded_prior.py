"""Recorded poses in the state of a run: where the next frame is, frames that no image places, and ties of keyframes.

All this only while the images agree with them (`tracking/recorded_motion.py`): until then, and where they are of
another recording, a run with them is to the last bit the run without.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import submap_of
from vggtgeo.slam.sparse_map.units import longer
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.recorded_motion import carried, compare, recorded_tie
from vggtgeo.slam.tracking.track import Track
from vggtgeo.slam.tracking.tracker import FramePose


@dataclass(frozen=True, eq=False)
class RecordedPrior:
    """Recorded poses that the images agree with. unit: what a unit of theirs is in the map's."""

    recorded: RecordedPoses
    unit: float

    def step(self, slam: Slam, time: float) -> np.ndarray | None:
        """Return the motion of the camera from the last frame with a pose to `time`, in the unit of the map."""
        last = last_placed(slam)
        motion = None if last is None else self.recorded.motion(last.timestamp, time)
        return None if motion is None else longer(motion, self.unit)

    def carried(self, slam: Slam, time: float) -> Track | None:
        """Place a frame that images do not place, by the recorded motion from the last one with a pose."""
        last = last_placed(slam)
        return None if last is None else carried(self.recorded, slam.map, last, time, self.unit)

    def length(self, keyframe: Keyframe, time: float) -> float | None:
        """Return the length of the motion from a keyframe to `time`, in the unit of the map."""
        motion = self.recorded.motion(keyframe.timestamp, time)
        return None if motion is None else self.unit * float(np.linalg.norm(motion[:3, 3]))

    def with_tie(self, slam: Slam) -> Slam:
        """Add the recorded motion to the newest keyframe from the one before, if both are in one submap."""
        label, (before, newest) = submap_of(slam.map), slam.keyframes[-2:]
        known = any(tie.keyframes == (before.number, newest.number) for tie in slam.map.recorded_factors)
        tie = recorded_tie(self.recorded, before, newest, self.unit)
        if tie is None or known or label[before.number] != label[newest.number]:
            return slam
        return slam.with_factors(tie)


def recorded_prior(slam: Slam, roles: Roles) -> RecordedPrior | None:
    """Return the recorded poses of a run, while images agree with them."""
    if roles.recorded is None:
        return None
    found = compare(roles.recorded, slam.map)
    return RecordedPrior(roles.recorded, found.unit) if found.accepted and found.unit is not None else None


def last_placed(slam: Slam) -> FramePose | None:
    """Return the last frame that has a pose."""
    return next((record for record in reversed(slam.frames) if record.tracked), None)


def prior_summary(slam: Slam, roles: Roles) -> dict[str, Any]:
    """Return the summary's entry on recorded poses, if there are any: whether they were used, how many motions were
    compared, the logarithm of the likelihood ratio, and how many of the map's units a unit of theirs is.
    """
    if roles.recorded is None:
        return {}
    found = compare(roles.recorded, slam.map)
    return {"pose_prior": {"used": found.accepted, **asdict(found)}}
