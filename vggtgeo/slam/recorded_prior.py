"""Recorded poses in the state of a run: where the next frame is, frames that no image places, and ties of keyframes.

All this only while the images agree with them (`tracking/recorded_motion.py`): until then, and where they are of
another recording, a run with them is to the last bit the run without.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.connected import piece_of
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.units import longer
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.recorded_motion import Comparison, carried, compare, recorded_tie, recorded_ties
from vggtgeo.slam.tracking.track import Track
from vggtgeo.slam.tracking.tracker import FramePose


@dataclass(frozen=True, eq=False)
class RecordedPrior:
    """Recorded poses that the images agree with. unit: what a unit of theirs is in the map's."""

    recorded: RecordedPoses
    unit: float

    def step(self, slam: Slam, time: float) -> np.ndarray | None:
        """The motion of the camera from the last frame with a pose to `time`, in the unit of the map."""
        last = last_placed(slam)
        motion = None if last is None else self.recorded.motion(last.timestamp, time)
        return None if motion is None else longer(motion, self.unit)

    def carried(self, slam: Slam, time: float) -> Track | None:
        """A frame that images do not place, by the motion from the last one that has a pose."""
        last = last_placed(slam)
        return None if last is None else carried(self.recorded, slam.map, last, time, self.unit)

    def length(self, keyframe: Keyframe, time: float) -> float | None:
        """Of the motion from a keyframe to `time`, in the unit of the map."""
        motion = self.recorded.motion(keyframe.timestamp, time)
        return None if motion is None else self.unit * float(np.linalg.norm(motion[:3, 3]))

    def tie(self, first: Keyframe, second: Keyframe) -> tuple[MeasuredRelativePose, ...]:
        """The recorded motion between two keyframes, if any."""
        found = recorded_tie(self.recorded, first, second, self.unit)
        return () if found is None else (found,)


def recorded_prior(slam: Slam, roles: Roles) -> RecordedPrior | None:
    """The recorded poses of a run, while images agree with them."""
    if roles.recorded is None:
        return None
    found = compare(roles.recorded, slam.map)
    return RecordedPrior(roles.recorded, found.unit) if found.believed else None


def last_placed(slam: Slam) -> FramePose | None:
    """The last frame that has a pose."""
    return next((record for record in reversed(slam.frames) if record.tracked), None)


def with_recorded_ties(slam: Slam, roles: Roles) -> Slam:
    """The state before its last adjustment, with all recorded motions between keyframes in the unit that all of them
    tell; without any where the images contradict them. A map of free scale takes its unit from them.
    """
    if roles.recorded is None:
        return slam
    found = compare(roles.recorded, slam.map)
    factors = [factor for factor in slam.map.factors if not getattr(factor, "recorded", False)]
    # A keyframe that no image ties to the others stays tied by what was recorded.
    alone = [tie for tie in slam.map.recorded_factors if not found.believed and _alone(slam, tie)]
    ties = recorded_ties(roles.recorded, slam.map, piece_of(slam.map), found.unit) if found.believed else alone
    if ties and not slam.metric:
        factors = [factor for factor in factors if not isinstance(factor, MeasuredBaseline)]
    note = _note(found)
    return replace(
        slam, map=replace(slam.map, factors=(*factors, *ties)), notes=(*slam.notes, *([note] if note else []))
    )


def prior_summary(slam: Slam, roles: Roles) -> dict[str, Any]:
    """Return the summary's entry on recorded poses, if there are any: whether they were used, how many of the last
    motions were compared and agree, and how many of the map's units a unit of theirs is.
    """
    if roles.recorded is None:
        return {}
    found = compare(roles.recorded, slam.map)
    return {"pose_prior": {"used": found.believed, **asdict(found)}}


def _alone(slam: Slam, tie: MeasuredRelativePose) -> bool:
    """Whether nothing else ties the later keyframe of a recorded motion to an earlier one."""
    earlier = [pair.first for pair in slam.map.pairs if pair.second == tie.second and len(pair.points)]
    tracked = [other.first for other in slam.map.odometry_factors if other.second == tie.second]
    return not any(number < tie.second for number in (*earlier, *tracked))


def _note(found: Comparison) -> str:
    if found.believed:
        return (
            f"recorded poses are a prior of the motion: {found.agreeing} of the last {found.compared} agree with images"
        )
    if found.contradicted:
        return (
            f"the recorded poses are not of these images, and are not used: {found.agreeing} of the last "
            f"{found.compared} motions agree"
        )
    return f"the recorded poses could be compared with {found.compared} motions, too few, and are not used"
