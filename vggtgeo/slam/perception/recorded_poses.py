"""Poses that came with the recording (a phone's, a robot's odometry): what they say of the motion between two times.

They are a prior of motions, never of places. Their errors grow with the way and with time (`covariance`), and their
unit is their own.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory

FLOOR = (0.005, np.deg2rad(0.2))
"""Standard deviation of a recorded motion however short, metres and radians: clocks and the place of the camera in the
device."""
LONGEST_GAP = 2.5
"""Usual intervals between two recorded poses beyond which nothing is known between them: one may be missing, not
two."""


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Recorded poses as a prior of the motion.

    Fields:
        trajectory: Camera -> world at times of the frames' clock; any world.
        drift: Standard deviation of a translation, as a share of it: generous, so that a true recording is
            not taken for another.
        turn: Standard deviation of a rotation, radians a second: a degree a minute, generous too.
        metres: Whether its lengths are metres.

    """

    trajectory: Trajectory
    drift: float = 0.02
    turn: float = float(np.deg2rad(1.0)) / 60.0
    metres: bool = True

    def __repr__(self) -> str:
        content = self.trajectory.timestamps.tobytes() + self.trajectory.poses.tobytes()
        digest = hashlib.sha256(content).hexdigest()[:16]
        return f"RecordedPoses({self.trajectory!r}, {digest}, {self.drift}, {self.turn}, {self.metres})"

    @cached_property
    def _interval(self) -> float:
        return float(np.median(np.diff(self.trajectory.timestamps))) if len(self.trajectory) > 1 else 0.0

    def pose(self, time: float) -> np.ndarray | None:
        """Return world -> camera at a time, float64 [4, 4], interpolated; None if no recorded pose is near."""
        times, poses = self.trajectory.timestamps, self.trajectory.poses
        after = int(np.searchsorted(times, time))
        if after < len(times) and times[after] == time:
            return rigid.invert(poses[after])
        if not 0 < after < len(times) or times[after] - times[after - 1] > LONGEST_GAP * self._interval:
            return None
        share = (time - times[after - 1]) / (times[after] - times[after - 1])
        step = rigid.invert(poses[after]) @ poses[after - 1]
        return np.asarray(rigid.fraction(step, share) @ rigid.invert(poses[after - 1]))

    def motion(self, first: float, second: float) -> np.ndarray | None:
        """Return camera at one time -> camera at another, float64 [4, 4]; None if a recorded pose is missing."""
        one, other = self.pose(first), self.pose(second)
        return None if one is None or other is None else rigid.orthonormal(other @ rigid.invert(one))

    def covariance(self, motion: np.ndarray, seconds: float) -> np.ndarray:
        """Return the covariance of a motion in metres, float64 [6, 6], translation first, over its left tangent."""
        metres, radians = FLOOR
        along = self.drift * np.linalg.norm(motion[:3, 3]) + metres
        turned = self.turn * abs(seconds) + radians
        return np.diag(np.repeat([along, turned], 3) ** 2)
