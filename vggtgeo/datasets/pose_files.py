"""Files of poses and cameras: matrices, CSV, YAML, JSON, and trajectories of TUM, KITTI and EuRoC."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vggtgeo.geometry.trajectory import MAX_COORDINATE, MAX_TIME, Trajectory, poses_of, read_matrices, rising
from vggtgeo.io.errors import InputError, InputWarning, NoteWarning, warn
from vggtgeo.io.files import whole_text

_KITTI, _EUROC = 12, 17
"""Columns of their trajectory files."""
_ROUNDING = 1e-5
"""Rounding of printed rotations, which stay unchanged so that errors equal those of other programs."""
_NANOSECONDS = 1e17
"""Times above it: seconds since 1970 are below 1e10, nanoseconds above 1e18."""
_MAX_STRETCH = 0.1
"""Maximum error of the lengths of a pose's axes; smaller ones (few digits, a scale of 1 %) are corrected."""


@contextmanager
def parsing(file: Path, expected: str) -> Iterator[None]:
    """Raise InputError, with the file and what it must hold, where its content cannot be used."""
    try:
        yield
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
        if f"`{file}`" in str(error):
            raise
        found = f"{error} is missing" if isinstance(error, LookupError) else error
        raise InputError(f"`{file}`: {found}; expected {expected}") from None


def read_matrix(file: Path, shape: tuple[int, int]) -> Float[np.ndarray, "r c"]:
    """Return one matrix; raise InputError if the file is missing or has another number of values."""
    text = whole_text(file)
    try:
        return np.array(text.replace(",", " ").split(), np.float64).reshape(shape)
    except ValueError:
        raise InputError(f"`{file}`: expected a matrix of {shape[0]} x {shape[1]} numbers") from None


def trajectory_of(times: Sequence[float] | np.ndarray, poses: np.ndarray, where: Path) -> Trajectory | None:
    """Return camera -> world at `times`, sorted by time; None if no pose is valid.

    Warns of poses that are left out: with NaN or infinity (lost tracking), without a rotation, or with a repeated
    time.
    """
    poses = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    times = np.asarray(times, np.float64)[: len(poses)]
    known = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    near = known & (np.abs(poses[:, :3, 3]) <= MAX_COORDINATE).all(axis=1) & (np.abs(times) <= MAX_TIME)
    turned = near & have_rotations(np.nan_to_num(poses, nan=0.0, posinf=0.0, neginf=0.0))
    for lost, why, kind in (
        (~known, "a NaN or an infinity", NoteWarning),
        (known & ~near, "a number that is no time or place", InputWarning),
        (near & ~turned, "no rotation (all zeros, mirrored or scaled, say)", InputWarning),
    ):
        if lost.any():
            warn(f"`{where}`: {int(lost.sum())} of {len(poses)} poses have {why}; left out", kind)
    if not len(poses) and where.is_file():
        warn(f"`{where}` has no pose")
    if not turned.any():
        return None
    rows = np.flatnonzero(turned)
    rows = rows[rising(where, times[rows])]
    return Trajectory(times[rows], _orthonormal(poses[rows]))


def trajectory_of_rows(
    times: Sequence[float], rows: Sequence[int], poses: np.ndarray, where: Path
) -> Trajectory | None:
    """Return `trajectory_of` images whose poses are these lines of a file; warn of lines beyond its end."""
    there = [place for place, row in enumerate(rows) if row < len(poses)]
    beyond = len(rows) - len(there)
    if beyond:
        warn(
            f"`{where}`: {beyond} of {len(rows)} images, by their numbers up to {max(rows)} counted from 0, are beyond "
            f"its end (poses: {len(poses)}) and have no truth"
        )
    if not there:
        return None
    return trajectory_of([times[place] for place in there], poses[[rows[place] for place in there]], where)


def poses_of_rows(rows: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 4 4"]:
    """Return matrices of their upper three rows, as KITTI writes them."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return poses


def yaml_numbers(
    file: Path, key: str, count: int | None = None, unstated: Sequence[float] | None = None
) -> Sequence[float]:
    """Return the list of numbers after `key:` in a YAML file as the benchmarks write them: `key: [1, 2, 3]`.

    unstated: the default if it is missing. Raises InputError if it is missing without a default, or does not have
    `count` values (None: any number).
    """
    found = re.search(rf"^\s*{re.escape(key)}\s*:\s*\[([^\]]*)\]", whole_text(file), re.MULTILINE)
    if found is None and unstated is not None:
        return unstated
    if found is None:
        raise InputError(f"`{file}` has no list `{key}: [...]`")
    words = found.group(1).replace(",", " ").split()
    if count is not None and len(words) != count:
        raise InputError(f"`{file}`: `{key}` has {len(words)} numbers; expected {count}")
    return numbers_of(words, f"`{file}`: `{key}`")


def numbers_of(words: Sequence[str], what: str) -> list[float]:
    """Return words as numbers; raise InputError naming `what` if one is not a number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        raise InputError(f"{what} is {' '.join(words)[:60]!r}; expected numbers") from None


def read_json(file: Path) -> Any:
    """Return the content of a JSON file; raise InputError if it is not valid JSON."""
    return json_in(whole_text(file), file)


def json_in(content: str | bytes, where: Path) -> Any:
    """Return the content of JSON text; raise InputError naming `where` if it is not valid JSON."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:  # of too many brackets
        raise InputError(f"`{where}` is not valid JSON: {error}") from None


def same_size(stated: Sequence[object], size: tuple[int, int]) -> bool:
    """Return whether a width and a height of JSON are these: scripts write `640`, `640.0` and `"640"`."""
    try:
        return tuple(float(str(side)) for side in stated) == size
    except ValueError:
        return False


def check_size(file: Path, stated: Sequence[object], size: tuple[int, int]) -> None:
    """Raise InputError if a camera's file is of images of another size."""
    if not same_size(stated, size):
        raise InputError(f"`{file}` is for {stated[0]} x {stated[1]} pixels; the images are {size[0]} x {size[1]}")


def have_rotations(poses: np.ndarray) -> np.ndarray:
    """Return whether the axes of each pose have nearly unit length and are right-handed, with last row 0 0 0 1."""
    last = (np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]) < _MAX_STRETCH).all(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):  # what is no rotation may be of any size
        lengths = np.linalg.norm(poses[:, :3, :3], axis=1)
        near = (np.abs(lengths - 1.0) < _MAX_STRETCH).all(axis=1)
        return np.asarray(last & near & (np.linalg.det(poses[:, :3, :3]) > 0.0), bool)


def _orthonormal(poses: np.ndarray) -> np.ndarray:
    """Return the nearest rigid motions: files have few digits, or a scale of 1 +- 1e-3."""
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    return np.concatenate([np.concatenate([u @ vt, poses[:, :3, 3:]], axis=2), poses[:, 3:]], axis=1)


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
    text = whole_text(file) if file.is_file() else ""
    lines = (line.split("#", 1)[0].replace(",", " ").split() for line in text.splitlines())
    columns = len(next(filter(None, lines), ()))
    if columns == _KITTI:
        return _kitti(file, clock)
    if columns == _EUROC:
        rows = read_matrices(file, _EUROC)
        return _with_poses(1e-9 * rows[:, 0], poses_of(rows[:, 1:4], rows[:, [5, 6, 7, 4]]), file)
    found = Trajectory.load_tum(file)
    if found.timestamps[0] < _NANOSECONDS:
        return found
    warn(f"`{file}`: its times are nanoseconds, and are converted", NoteWarning)
    return Trajectory(1e-9 * found.timestamps, found.poses)


def _kitti(file: Path, clock: Trajectory | None) -> Trajectory:
    rows = read_matrices(file, _KITTI)
    if clock is not None and len(clock) != len(rows):
        raise InputError(
            f"`{file}` has {len(rows)} poses without times (12 columns), the truth {len(clock)}; give as many, or "
            "a file with times, `timestamp tx ty tz qx qy qz qw`"
        )
    poses = poses_of_rows(rows)
    times = np.arange(float(len(rows))) if clock is None else clock.timestamps
    found = _with_poses(times, poses, file)
    rounded = len(found) == len(poses) and np.abs(found.poses - poses).max() < _ROUNDING
    return Trajectory(found.timestamps, poses) if rounded else found


def _with_poses(times: np.ndarray, poses: np.ndarray, file: Path) -> Trajectory:
    found = trajectory_of(times, poses, file)
    if found is None:
        raise InputError(f"`{file}` holds no pose")
    return found
