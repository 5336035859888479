"""A trajectory between its poses: cubic splines of positions and of rotations, both with continuous velocity."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vggtgeo.geometry.trajectory import Trajectory


class ContinuousTrajectory:
    """Poses and velocities of a trajectory of two or more poses at any time between its first and its last one.

    Source of the rotations: scipy's `RotationSpline`, whose angular velocity is continuous.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self.times = trajectory.timestamps
        self._begin = self.times[0]  # times since 1970 keep their microseconds where they are taken from the first
        since = self.times - self._begin
        self._positions = CubicSpline(since, trajectory.positions)
        self._rotations = RotationSpline(since, Rotation.from_matrix(trajectory.rotations))

    def covers(self, times: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Which times lie between two poses that are at most two usual intervals apart; a spline invents more."""
        after = np.searchsorted(self.times, times).clip(1, len(self.times) - 1)
        gap = self.times[after] - self.times[after - 1]
        inside = (times >= self.times[0]) & (times <= self.times[-1])
        return inside & (gap <= 2.0 * np.median(np.diff(self.times)))

    def poses(self, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """Body -> world."""
        found = np.tile(np.eye(4), (len(times), 1, 1))
        found[:, :3, :3] = self._rotations(times - self._begin).as_matrix()
        found[:, :3, 3] = self._positions(times - self._begin)
        return found

    def velocities(self, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 6"]:
        """Of the body, in the world: metres and radians a second."""
        since = times - self._begin
        turning = self._rotations(since).apply(self._rotations(since, 1))
        return np.concatenate([self._positions(since, 1), turning], axis=1)
