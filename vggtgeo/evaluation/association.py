"""Associate the poses of two trajectories, by the nearest time as the `evo` package, or by interpolation."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_real
from vggtgeo.io.errors import InputError

MAX_TIME_DIFFERENCE = 0.01
"""Maximum time difference of a match, seconds; evo's default."""


def nearest_in_time(
    times: Float[np.ndarray, " n"], others: Float[np.ndarray, " m"], max_dt: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Match each of `times` with the nearest of `others` (increasing) within `max_dt` seconds; ties go to the earlier.

    Returns the matched rows of `times`, and the row of `others` for each. A row of `others` may be used several times.
    """
    if len(others) == 0 or len(times) == 0:
        return np.zeros(0, int), np.zeros(0, int)
    after = np.clip(np.searchsorted(others, times, side="right"), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    to_after, to_before = others[after] - times, times - others[before]
    nearest = np.where(np.abs(to_after) < np.abs(to_before), after, before)
    rows = np.flatnonzero(np.abs(others[nearest] - times) <= max_dt)
    return rows, nearest[rows]


def associate(
    estimate: Trajectory, truth: Trajectory, max_dt: float = MAX_TIME_DIFFERENCE
) -> tuple[Trajectory, Trajectory]:
    """Match the poses of two trajectories that are at most `max_dt` seconds apart; return both, pose by pose.

    Each pose of the shorter trajectory is matched with the nearest of the longer one. Both results have the times of
    the shorter trajectory. Raises InputError if `max_dt` is negative, or no poses match.
    """
    check_real("max_dt", max_dt)
    if not max_dt >= 0:
        raise InputError(f"`max_dt` must be at least 0 seconds, got {max_dt}")
    if len(truth) < len(estimate):
        truth_rows, estimate_rows = nearest_in_time(truth.timestamps, estimate.timestamps, max_dt)
        times = truth.timestamps[truth_rows]
    else:
        estimate_rows, truth_rows = nearest_in_time(estimate.timestamps, truth.timestamps, max_dt)
        times = estimate.timestamps[estimate_rows]
    if len(times) == 0:
        raise InputError(f"poses must match within `max_dt` {max_dt:g} s, got no match: {spans(estimate, truth)}")
    return Trajectory(times, estimate.poses[estimate_rows]), Trajectory(times, truth.poses[truth_rows])


def spans(estimate: Trajectory, truth: Trajectory) -> str:
    """Return text with the time spans of both trajectories, for the error that they do not match."""
    parts = []
    for name, trajectory in (("`estimate`", estimate), ("`truth`", truth)):
        times = trajectory.timestamps
        span = f"from {times[0]:.3f} to {times[-1]:.3f} s" if len(times) else "empty"
        parts.append(f"{name} is {span} ({len(times)} poses)")
    return ", ".join(parts) + "; check that both use the same clock, or allow a larger `max_dt`"


class ContinuousTrajectory:
    """Poses and velocities of a trajectory (two or more poses) at any time between its first and last pose.

    Cubic splines of positions and rotations (scipy's `RotationSpline`), with continuous velocity.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self.times = trajectory.timestamps
        self._begin = self.times[0]  # subtracted, since the spline of times since 1970 would lose microseconds
        since = self.times - self._begin
        self._positions = CubicSpline(since, trajectory.positions)
        self._rotations = RotationSpline(since, Rotation.from_matrix(trajectory.rotations))

    def covers(self, times: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return which times are between two poses at most two median intervals apart: splines are wrong in gaps."""
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


def shifted(estimate: Trajectory, truth: Trajectory, seconds: float) -> Trajectory:
    """Return the ground truth with `seconds` added to its times, and poses interpolated at the estimate's times."""
    times = truth.timestamps + seconds
    moved = Trajectory(times, truth.poses)
    if len(truth) < 2:
        return moved
    continuous = ContinuousTrajectory(moved)
    between = estimate.timestamps[continuous.covers(estimate.timestamps)]
    between = between[~np.isin(between, times)]
    order = np.argsort(np.concatenate([times, between]), kind="stable")
    poses = np.concatenate([truth.poses, continuous.poses(between)])
    return Trajectory(np.concatenate([times, between])[order], poses[order])
