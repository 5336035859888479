"""Interpolation of a trajectory by cubic splines of positions and rotations, with continuous velocity."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vggtgeo.geometry.trajectory import Trajectory


class ContinuousTrajectory:
    """Poses and velocities of a trajectory (two or more poses) at any time between its first and last pose.

    Rotations: scipy's `RotationSpline`.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self.times = trajectory.timestamps
        self._begin = self.times[0]  # relative times keep microseconds, which times since 1970 lose in the spline
        since = self.times - self._begin
        self._positions = CubicSpline(since, trajectory.positions)
        self._rotations = RotationSpline(since, Rotation.from_matrix(trajectory.rotations))

    def covers(self, times: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return which times lie between two poses at most two median intervals apart: a spline is wrong in gaps."""
        after = np.searchsorted(self.times, times).clip(1, len(self.times) - 1)
        gap = self.times[after] - self.times[after - 1]
        inside = (times >= self.times[0]) & (times <= self.times[-1])
        return inside & (gap <= 2.0 * np.median(np.diff(self.times)))

    def poses(self, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """Return the poses, body -> world."""
        found = np.tile(np.eye(4), (len(times), 1, 1))
        found[:, :3, :3] = self._rotations(times - self._begin).as_matrix()
        found[:, :3, 3] = self._positions(times - self._begin)
        return found

    def velocities(self, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 6"]:
        """Return linear and angular velocity of the body in the world frame, m/s and rad/s."""
        since = times - self._begin
        turning = self._rotations(since).apply(self._rotations(since, 1))
        return np.concatenate([self._positions(since, 1), turning], axis=1)
