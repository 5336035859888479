"""Trajectory files of TUM, KITTI and EuRoC, distinguished by their number of columns."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np

from vggtgeo.datasets.pose_files import poses_of, read_matrices, read_text, trajectory_of
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, NoteWarning

_KITTI, _EUROC = 12, 17
_ROUNDING = 1e-5
"""Rounding of printed rotations, which stay unchanged so that errors equal those of other programs."""
_NANOSECONDS = 1e17
"""Times above it: seconds since 1970 are below 1e10, nanoseconds above 1e18."""


def load_trajectory(path: str | os.PathLike[str], clock: Trajectory | None = None) -> Trajectory:
    """Return the trajectory in a file of

    - 8 columns, `timestamp tx ty tz qx qy qz qw` (TUM); times in nanoseconds (ORB-SLAM3 with EuRoC) are
      converted, with a warning,
    - 12 columns, the upper three rows of camera -> world (KITTI). They have no times: the times
      of `clock`, which must have as many poses, or their numbers without one,
    - 17 columns, EuRoC's `state_groundtruth_estimate0/data.csv`: the poses of the IMU.

    Raises InputError as `Trajectory.load_tum`, and for poses without times if `clock` has another number of poses.
    """
    file = Path(path)
    columns = _columns(file) if file.is_file() else 8
    if columns == _KITTI:
        return _kitti(file, clock)
    if columns == _EUROC:
        rows = read_matrices(file, _EUROC)
        found = trajectory_of(1e-9 * rows[:, 0], poses_of(rows[:, 1:4], rows[:, [5, 6, 7, 4]]), file, "trajectory")
        if found is None:
            raise InputError(f"`{file}` holds no pose")
        return found
    found = Trajectory.load_tum(file)
    if found.timestamps[0] < _NANOSECONDS:
        return found
    warnings.warn(f"`{file}`: its times are nanoseconds, and are converted", NoteWarning, stacklevel=2)
    return Trajectory(1e-9 * found.timestamps, found.poses)


def _columns(file: Path) -> int:
    """Return the number of columns of the first line with any."""
    lines = (line.split("#", 1)[0].replace(",", " ").split() for line in read_text(file).splitlines())
    return len(next((words for words in lines if words), ()))


def _kitti(file: Path, clock: Trajectory | None) -> Trajectory:
    rows = read_matrices(file, _KITTI)
    if clock is not None and len(clock) != len(rows):
        raise InputError(
            f"`{file}` has poses without times (12 columns, KITTI), and {len(rows)} of them beside {len(clock)} of the "
            "truth; give one for each of those, or a file with times, `timestamp tx ty tz qx qy qz qw`"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    times = np.arange(float(len(rows))) if clock is None else clock.timestamps
    found = trajectory_of(times, poses, file, "trajectory")
    if found is None:
        raise InputError(f"`{file}` holds no pose")
    rounded = len(found) == len(poses) and np.abs(found.poses - poses).max() < _ROUNDING
    return Trajectory(found.timestamps, poses) if rounded else found
