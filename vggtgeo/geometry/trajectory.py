"""Trajectories: timed camera poses, and their files in the TUM format.

A line of the file is `timestamp tx ty tz qx qy qz qw`: seconds, metres, unit quaternion, camera -> world.
"""

import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from vggtgeo.io.argument_checks import path_of, real_array
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import whole_text, write_text

_HEADER = "# timestamp tx ty tz qx qy qz qw (camera to world)\n"
MIN_QUATERNION, MAX_QUATERNION = 0.5, 2.0
"""Range of lengths of a quaternion in a file; other columns have other lengths."""
MAX_COORDINATE, MAX_TIME = 1e15, 1e20
"""Largest coordinates and times in a file: their squares are finite, and nanoseconds since 1970 are less."""
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses at increasing times.

    Fields:
        timestamps: float64 [n], seconds, strictly increasing.
        poses: float64 [n, 4, 4], camera -> world, metres (or the unit of a scale-free reconstruction).

    Raises InputError for other shapes, NaN or infinity, times that do not increase, or what is no rotation.

    Example:
        >>> import numpy as np, vggtgeo as vg
        >>> poses = np.tile(np.eye(4), (3, 1, 1))
        >>> poses[:, 0, 3] = [0, 1, 2]
        >>> vg.Trajectory(np.array([0.0, 0.5, 1.0]), poses)
        Trajectory(3 poses, 1.00 s, path 2.00 m)

    """

    timestamps: Float[np.ndarray, " n"]
    poses: Float[np.ndarray, "n 4 4"]

    def __post_init__(self) -> None:
        times = np.asarray(real_array("timestamps", self.timestamps, (None,)), np.float64)
        object.__setattr__(self, "timestamps", times)
        object.__setattr__(self, "poses", np.asarray(real_array("poses", self.poses, (len(times), 4, 4)), np.float64))
        _check(self.timestamps, self.poses)

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Camera centres in the world, metres."""
        return self.poses[:, :3, 3]

    @property
    def rotations(self) -> Float[np.ndarray, "n 3 3"]:
        """Camera -> world rotations."""
        return self.poses[:, :3, :3]

    @property
    def length(self) -> float:
        """Length of the path through the camera centres, metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @property
    def _quaternions(self) -> np.ndarray:
        return Rotation.from_matrix(self.rotations).as_quat(canonical=True) if len(self) else np.zeros((0, 4))

    def to_dict(self) -> dict[str, list]:
        """Return times, positions and quaternions (x, y, z, w) as plain lists."""
        return {
            "timestamps": self.timestamps.tolist(),
            "positions": self.positions.tolist(),
            "quaternions": self._quaternions.tolist(),
        }

    def __repr__(self) -> str:
        seconds = self.timestamps[-1] - self.timestamps[0] if len(self) else 0.0
        return f"Trajectory({len(self)} pose{'s' * (len(self) != 1)}, {seconds:.2f} s, path {self.length:.2f} m)"

    def select(self, rows: np.ndarray | slice) -> Self:
        """Return the poses at `rows` (indices in increasing order, a boolean mask, or a slice)."""
        try:
            return type(self)(self.timestamps[rows], self.poses[rows])
        except IndexError as error:
            raise InputError(f"`rows` cannot be rows of {len(self)} poses: {error}") from None

    def save_tum(self, path: str | os.PathLike[str]) -> None:
        """Write the TUM format, nine decimals, atomically."""
        rows = np.column_stack([self.timestamps, self.positions, self._quaternions])
        lines = (" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows.tolist())
        write_text(path, _HEADER + "".join(lines))

    @classmethod
    def load_tum(cls, path: str | os.PathLike[str]) -> Self:
        """Read the TUM format (blanks or commas; `#` begins a comment).

        Quaternions are normalised. Lines out of order are sorted, and of lines with one time the first is
        kept, both with an InputWarning. InputError names the file, and the line or the pose, for a missing file, a
        wrong number of columns, what is not a finite number, or a quaternion of length zero.
        """
        file = path_of("path", path)
        rows = read_matrices(file, 8)
        if not len(rows):
            raise InputError(f"`{file}` has no pose; a line must be `timestamp tx ty tz qx qy qz qw`")
        with np.errstate(over="ignore"):
            lengths = np.linalg.norm(rows[:, 4:], axis=1)
        valid = np.isfinite(rows).all(axis=1) & (lengths >= MIN_QUATERNION) & (lengths <= MAX_QUATERNION)
        if not valid.all():
            bad = int(np.argmin(valid))
            raise InputError(
                f"`{file}`: pose {bad + 1} of {len(rows)} is {rows[bad].tolist()}; expected finite numbers `timestamp "
                "tx ty tz qx qy qz qw`, with a quaternion of length 1"
            )
        rows = rows[rising(path, rows[:, 0])]
        return cls(rows[:, 0], poses_of(rows[:, 1:4], rows[:, 4:]))


def _check(timestamps: np.ndarray, poses: np.ndarray) -> None:
    count = len(timestamps)
    finite = np.isfinite(timestamps) & np.isfinite(poses).all(axis=(1, 2))
    if not finite.all():
        raise InputError(f"pose {int(np.argmin(finite))} of {count} has a NaN or an infinity; leave such poses out")
    steps = np.diff(timestamps)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0))
        raise InputError(
            f"`timestamps` must increase; entry {row + 1} is {timestamps[row + 1]:.6f} after "
            f"{timestamps[row]:.6f}: sort them, and keep one pose for a time"
        )
    rotations = poses[:, :3, :3]
    # `R R' = I` holds for reflections too, which the determinant below excludes.
    off = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    bad = (off > _ROTATION_TOLERANCE) | (np.linalg.det(rotations) <= 0)
    if bad.any():
        raise InputError(f"pose {int(np.argmax(bad))} of {count} must have a rotation in its upper left 3 x 3 block")


def read_matrices(file: Path, columns: int, skip: str = "#") -> Float[np.ndarray, "n c"]:
    """Return lines of `columns` numbers, separated by blanks or commas; raise InputError naming an invalid line."""
    rows = []
    for number, line in enumerate(whole_text(file).splitlines(), start=1):
        words = line.split(skip, 1)[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != columns:
            raise InputError(f"`{file}`, line {number}: found {line.strip()[:60]!r}; expected {columns} numbers")
        rows.append(row)
    return np.array(rows, np.float64).reshape(-1, columns)


def poses_of(positions: np.ndarray, quaternions: np.ndarray) -> Float[np.ndarray, "n 4 4"]:
    """Return matrices of positions [n, 3] and quaternions [n, 4], x y z w; the rotation is 0 if the length of a
    quaternion is not about 1.
    """
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    turned = (length >= MIN_QUATERNION) & (length <= MAX_QUATERNION)
    rotations = Rotation.from_quat(np.where(turned, quaternions, [0.0, 0.0, 0.0, 1.0])).as_matrix()
    unknown = np.where(np.isfinite(length), 0.0, np.nan)
    poses[:, :3, :3] = np.where(turned[..., None], rotations, unknown[..., None])
    poses[:, :3, 3] = positions
    return poses


def rising(path: str | os.PathLike[str], times: Float[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Return the rows of a file that make a trajectory: sorted by time, the first of equal times.

    Warns (InputWarning, with the name of the file) if rows were sorted or dropped.
    """
    order = np.argsort(times, kind="stable")
    if (np.diff(times) < 0).any():
        row = int(np.argmax(np.diff(times) < 0)) + 1
        warnings.warn(
            f"`{path}`: timestamps are out of order (first {times[row]:.6f}); the poses were sorted",
            InputWarning,
            stacklevel=3,
        )
    first = np.diff(times[order], prepend=-np.inf) > 0
    if not first.all():
        warnings.warn(
            f"`{path}`: {int((~first).sum())} poses repeat the time of another (first at "
            f"{times[order][int(np.argmin(first))]:.6f}); the first of each was kept",
            InputWarning,
            stacklevel=3,
        )
    return order[first]
