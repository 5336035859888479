"""Read files of poses and cameras: matrices, CSV, YAML, JSON, and trajectories of TUM, KITTI and EuRoC."""

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
"""Columns of the trajectory files of these benchmarks."""
_ROUNDING = 1e-5
"""Maximum rounding error of printed rotations, which are not corrected, so that errors equal other programs'."""
_NANOSECONDS = 1e17
"""Larger times are nanoseconds: seconds since 1970 are below 1e10, nanoseconds above 1e18."""
_MAX_STRETCH = 0.1
"""Maximum error of the lengths of a pose's axes; smaller errors (few digits, a scale of 1 %) are corrected."""


@contextmanager
def parsing(file: Path, expected: str) -> Iterator[None]:
    """Turn errors of parsing into an InputError with the file and its expected content."""
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

    Warns of poses that are left out: with NaN or infinity (lost tracking), an invalid rotation, or a repeated time.
    """
    poses = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    times = np.asarray(times, np.float64)[: len(poses)]
    known = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    plausible = known & (np.abs(poses[:, :3, 3]) <= MAX_COORDINATE).all(axis=1) & (np.abs(times) <= MAX_TIME)
    valid = plausible & have_rotations(np.nan_to_num(poses, nan=0.0, posinf=0.0, neginf=0.0))
    for lost, why, kind in (
        (~known, "a NaN or an infinity", NoteWarning),
        (known & ~plausible, "an implausible time or position", InputWarning),
        (plausible & ~valid, "an invalid rotation (for example all zeros, mirrored or scaled)", InputWarning),
    ):
        if lost.any():
            warn(f"`{where}`: {int(lost.sum())} of {len(poses)} poses have {why}; left out", kind)
    if not len(poses) and where.is_file():
        warn(f"`{where}` has no pose")
    if not valid.any():
        return None
    rows = np.flatnonzero(valid)
    rows = rows[rising(where, times[rows])]
    return Trajectory(times[rows], _orthonormal(poses[rows]))


def trajectory_of_rows(
    times: Sequence[float], rows: Sequence[int], poses: np.ndarray, where: Path
) -> Trajectory | None:
    """Return `trajectory_of` for images whose poses are on the lines `rows` of a file; warn of lines after its end."""
    posed = [image for image, row in enumerate(rows) if row < len(poses)]
    beyond = len(rows) - len(posed)
    if beyond:
        warn(
            f"`{where}` has {len(poses)} poses; {beyond} of {len(rows)} images, with numbers up to {max(rows)} counted "
            "from 0, have no ground truth"
        )
    if not posed:
        return None
    return trajectory_of([times[image] for image in posed], poses[[rows[image] for image in posed]], where)


def poses_of_rows(rows: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 4 4"]:
    """Return poses from their upper three rows, as KITTI writes them."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return poses


def yaml_numbers(
    file: Path, key: str, count: int | None = None, unstated: Sequence[float] | None = None
) -> Sequence[float]:
    """Return the list of numbers after `key:` in a YAML file as the benchmarks write them: `key: [1, 2, 3]`.

    unstated: default value for a missing key. Raises InputError if the key is missing without a default, or does not
    have `count` values (None: any number).
    """
    found = re.search(rf"^\s*{re.escape(key)}\s*:\s*\[([^\]]*)\]", whole_text(file), re.MULTILINE)
    if found is None and unstated is not None:
        return unstated
    if found is None:
        raise InputError(f"`{file}` has no list `{key}: [...]`")
    words = found.group(1).replace(",", " ").split()
    if count is not None and len(words) != count:
        raise InputError(f"`{file}`: `{key}` must have {count} numbers, got {len(words)}")
    return numbers_of(words, f"`{file}`: `{key}`")


def numbers_of(words: Sequence[str], what: str) -> list[float]:
    """Return words as numbers; raise InputError naming `what` if one is not a number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        raise InputError(f"{what} must be numbers, got {' '.join(words)[:60]!r}") from None


def read_json(file: Path) -> Any:
    """Return the content of a JSON file; raise InputError if it is not valid JSON."""
    return json_in(whole_text(file), file)


def json_in(content: str | bytes, where: Path) -> Any:
    """Return the content of JSON text; raise InputError naming `where` if it is not valid JSON."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:  # RecursionError: too many nested brackets
        raise InputError(f"`{where}` is not valid JSON: {error}") from None


def same_size(stated: Sequence[object], size: tuple[int, int]) -> bool:
    """Return whether width and height of a JSON file equal `size`; scripts write `640`, `640.0` or `"640"`."""
    try:
        return tuple(float(str(side)) for side in stated) == size
    except ValueError:
        return False


def check_size(file: Path, stated: Sequence[object], size: tuple[int, int]) -> None:
    """Raise InputError if a camera file is for images of another size."""
    if not same_size(stated, size):
        raise InputError(f"`{file}` is for {stated[0]} x {stated[1]} pixels; the images are {size[0]} x {size[1]}")


def have_rotations(poses: np.ndarray) -> np.ndarray:
    """Return which poses have right-handed axes of about unit length, and the last row 0 0 0 1."""
    last = (np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]) < _MAX_STRETCH).all(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):  # invalid rotations may have any values
        lengths = np.linalg.norm(poses[:, :3, :3], axis=1)
        near = (np.abs(lengths - 1.0) < _MAX_STRETCH).all(axis=1)
        return np.asarray(last & near & (np.linalg.det(poses[:, :3, :3]) > 0.0), bool)


def _orthonormal(poses: np.ndarray) -> np.ndarray:
    """Return the nearest rigid motions: poses in files have few digits, or a scale of 1 +- 1e-3."""
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    return np.concatenate([np.concatenate([u @ vt, poses[:, :3, 3:]], axis=2), poses[:, 3:]], axis=1)


def load_trajectory(path: str | os.PathLike[str], clock: Trajectory | None = None) -> Trajectory:
    """Return the trajectory in a file of

    - 8 columns, `timestamp tx ty tz qx qy qz qw` (TUM); times in nanoseconds (ORB-SLAM3 with EuRoC) are
      converted, with a warning,
    - 12 columns, the upper three rows of camera -> world (KITTI). The file has no times: they are those of `clock`,
      which must have as many poses, or the numbers of the lines without a `clock`,
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
    warn(f"`{file}`: the times are nanoseconds and were converted to seconds", NoteWarning)
    return Trajectory(1e-9 * found.timestamps, found.poses)


def _kitti(file: Path, clock: Trajectory | None) -> Trajectory:
    rows = read_matrices(file, _KITTI)
    if clock is not None and len(clock) != len(rows):
        raise InputError(
            f"`{file}` must have as many poses as the ground truth, {len(clock)}, got {len(rows)}: its 12 columns "
            "have no times; or give a file with times, `timestamp tx ty tz qx qy qz qw`"
        )
    poses = poses_of_rows(rows)
    times = np.arange(float(len(rows))) if clock is None else clock.timestamps
    found = _with_poses(times, poses, file)
    rounded = len(found) == len(poses) and np.abs(found.poses - poses).max() < _ROUNDING
    return Trajectory(found.timestamps, poses) if rounded else found


def _with_poses(times: np.ndarray, poses: np.ndarray, file: Path) -> Trajectory:
    found = trajectory_of(times, poses, file)
    if found is None:
        raise InputError(f"`{file}` has no valid pose")
    return found
