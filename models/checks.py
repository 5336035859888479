"""Checks of arguments; each error names the argument, what it is and what it must be."""

from __future__ import annotations

from typing import Any

import numpy as np


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


def check_image(name: str, image: np.ndarray) -> None:
    """Raise ValueError unless an image is uint8 [H, W, 3]."""
    check_array(name, image, (None, None, 3))
    if image.dtype != np.uint8:
        raise ValueError(f"`{name}` must be uint8, got {image.dtype}")


def check_pose(name: str, pose: np.ndarray) -> None:
    """Raise ValueError unless a pose is a finite 4 x 4 rigid motion (to 1e-4: it may come from float32)."""
    check_array(name, pose, (4, 4))
    rotation = pose[:3, :3].astype(np.float64)
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > 1e-4 or np.linalg.det(rotation) < 0 or np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise ValueError(f"`{name}` must be a rigid motion [R t; 0 1], got a rotation with an error of {error:.2g}")
