"""Validate arguments. Each error names the argument, what it must be, and its value.

Checks of the user's input raise `InputError`. Checks of the perception roles (`check_fields`, `check_array` and those
after it) raise ValueError.
"""

from __future__ import annotations

import json
import math
import numbers
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.io.errors import InputError


def check_kind(name: str, given: Any, kind: Any, expected: str) -> None:
    """Raise InputError unless `given` has the type `kind`; expected: a noun for the type, and how to obtain it."""
    if not isinstance(given, kind):
        raise InputError(f"`{name}` must be {expected}, got the type `{type(given).__name__}`")


def path_of(name: str, given: Any) -> Path:
    """Return the path of a text or an `os.PathLike`, with `~` expanded to the home folder; it need not exist.

    Raises:
        InputError: another type (bytes, for example), or an empty path.

    """
    found = os.fspath(given) if isinstance(given, str | os.PathLike) else given
    if not isinstance(found, str):
        raise InputError(f"`{name}` must be a text or a `pathlib.Path`, got {given!r:.60}")
    if not found:
        raise InputError(f"`{name}` must not be empty, which would mean the current folder; give a path")
    return Path(os.path.expanduser(found))  # `Path.expanduser` raises for an unknown user


def check_whole(name: str, given: Any, minimum: int = 0, maximum: int | None = None) -> None:
    """Raise InputError unless `given` is an integer of Python or numpy in the range; booleans are not integers."""
    whole = isinstance(given, numbers.Integral) and not isinstance(given, bool | np.bool_)
    if not whole or given < minimum or (maximum is not None and given > maximum):
        until = "" if maximum is None else f" and at most {maximum}"
        raise InputError(f"`{name}` must be a whole number of at least {minimum}{until}, got {given!r:.60}")


def check_real(name: str, given: Any, must: str = "a number") -> None:
    """Raise InputError unless `given` is one real number or infinity."""
    found = np.asarray(given)
    if found.ndim or found.dtype.kind not in "iuf" or np.isnan(found):
        got = str(given) if found.dtype.kind == "f" and not found.ndim else f"{given!r:.60}"
        raise InputError(f"`{name}` must be {must}, got {got}")


def check_positive(name: str, given: Any, unit: str) -> None:
    """Raise InputError unless `given` is a positive, finite number."""
    check_real(name, given, f"positive {unit}")
    if not 0 < given < math.inf:
        raise InputError(f"`{name}` must be positive {unit}, got {given}")


def check_within(name: str, given: Any, low: float, high: float, units: str = "") -> None:
    """Raise InputError unless `given` is a number from `low` to `high`."""
    check_real(name, given)
    if not low <= given <= high:
        raise InputError(f"`{name}` must be from {low:g} to {high:g}{units}, got {given}")


def real_numbers(name: str, given: Any) -> np.ndarray:
    """Return an array of real numbers or booleans.

    Raises:
        InputError: text, objects, dates, ragged lists, complex numbers (NumPy would take their real part), or masked
            entries (NumPy would drop the mask).

    """
    try:
        found = np.asarray(given)
    except ValueError as error:
        raise InputError(f"`{name}` cannot be read as an array: {error}") from error
    if found.dtype.kind not in "biuf":
        got = {"c": "complex numbers", "M": "dates", "m": "durations"}.get(found.dtype.kind, f"{given!r:.60}")
        raise InputError(f"`{name}` must be real numbers, got {got}")
    if isinstance(given, np.ma.MaskedArray) and np.ma.is_masked(given):
        raise InputError(
            f"`{name}` must not have masked entries, which have no value; remove or fill them (`.filled(...)`)"
        )
    return found


def real_array(name: str, given: Any, shape: Sequence[int | None]) -> np.ndarray:
    """Return real numbers of this shape (None: any length); raise InputError as `real_numbers`."""
    found = real_numbers(name, given)
    if found.ndim != len(shape) or any(
        wanted not in (None, has) for wanted, has in zip(shape, found.shape, strict=True)
    ):
        letters = iter("nmk")
        wanted = ", ".join(next(letters) if length is None else str(length) for length in shape)
        raise InputError(f"`{name}` must have shape [{wanted}], got {list(found.shape)}")
    return found


def check_plain(name: str, given: Mapping[str, Any]) -> None:
    """Raise InputError for values that JSON cannot represent, so that a run need not fail when it writes them."""
    check_kind(name, given, Mapping, "a dictionary of plain values")
    try:
        json.JSONEncoder(allow_nan=False).encode(given)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"`{name}` cannot be written as JSON: {error}; give plain numbers, texts, lists and dictionaries"
        ) from None


def check_fields(settings: Any, **intervals: str) -> None:
    """Raise ValueError unless each field is in its interval, such as `ratio="(0, 1]"` or `count="[1, inf)"`."""
    for name, interval in intervals.items():
        value = getattr(settings, name)
        low, high = map(float, interval[1:-1].split(","))
        above = value > low if interval[0] == "(" else value >= low
        below = value < high if interval[-1] == ")" else value <= high
        if not (above and below):
            raise ValueError(f"`{name}` must be in {interval}, got {value}")


def check_array(name: str, array: np.ndarray, shape: tuple[int | None, ...], finite: bool = True) -> None:
    """Raise ValueError unless an array has `shape` (None: any length) and, with `finite`, no NaN or infinity."""
    if not isinstance(array, np.ndarray):
        raise TypeError(f"`{name}` must be a numpy array, got {type(array).__name__}")
    if array.ndim != len(shape) or any(
        length not in (None, found) for found, length in zip(array.shape, shape, strict=True)
    ):
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise ValueError(f"`{name}` must have shape [{wanted}], got {list(array.shape)}")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite, got {np.count_nonzero(~np.isfinite(array))} values that are not")


def check_confidence(name: str, array: np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Raise ValueError unless an array is finite, has `shape`, and is in [0, 1]."""
    check_array(name, array, shape)
    if array.size and (array.min() < 0 or array.max() > 1):
        raise ValueError(f"`{name}` must be in [0, 1], got {array.min():.3g} to {array.max():.3g}")


def check_index(name: str, array: np.ndarray, count: int, lowest: int) -> None:
    """Raise ValueError unless an array is int [count] with no value below `lowest`."""
    check_array(name, array, (count,))
    if array.dtype.kind not in "iu":
        raise ValueError(f"`{name}` must be integers, got {array.dtype}")
    if count and array.min() < lowest:
        raise ValueError(f"`{name}` must be at least {lowest}, got {array.min()}")


def check_pose(name: str, pose: np.ndarray) -> None:
    """Raise ValueError unless a pose is a finite 4 x 4 rigid motion (to 1e-4: it may come from float32)."""
    check_array(name, pose, (4, 4))
    rotation = pose[:3, :3].astype(np.float64)
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > 1e-4 or np.linalg.det(rotation) < 0 or np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise ValueError(f"`{name}` must be a rigid motion [R t; 0 1], got a rotation with an error of {error:.2g}")
