"""Checks of array arguments: each error names the argument, what was found, and what was expected."""

from __future__ import annotations

import numpy as np


def check_array(name: str, array: np.ndarray, shape: tuple[int | None, ...], finite: bool = True) -> None:
    """Raise `ValueError` unless `array` has `shape` (None = any length) and, with `finite`, no NaN or infinity."""
    if not isinstance(array, np.ndarray):
        raise TypeError(f"`{name}` is a {type(array).__name__}, expected a numpy array; convert it first")
    agrees = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=False)
    )
    if not agrees:
        wanted = "[" + ", ".join("any" if n is None else str(n) for n in shape) + "]"
        raise ValueError(f"`{name}` has shape {list(array.shape)}, expected {wanted}; reshape or pad it")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise ValueError(f"`{name}` has {bad} values that are not finite, expected none; remove or mask them")


def check_confidence(name: str, array: np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` is finite, has `shape`, and lies in [0, 1]."""
    check_array(name, array, shape)
    if array.size and (array.min() < 0 or array.max() > 1):
        raise ValueError(
            f"`{name}` ranges from {array.min():.3g} to {array.max():.3g}, expected values in [0, 1]; rescale it"
        )


def check_index(name: str, array: np.ndarray, count: int, lowest: int) -> None:
    """Raise `ValueError` unless `array` is int [count] with no value below `lowest`."""
    check_array(name, array, (count,))
    if array.dtype.kind not in "iu":
        raise ValueError(f"`{name}` has dtype {array.dtype}, expected integers; convert it with .astype(int)")
    if count and array.min() < lowest:
        raise ValueError(f"`{name}` has the value {array.min()}, expected at least {lowest}; check the indices")


def check_image(name: str, image: np.ndarray) -> None:
    """Raise `ValueError` unless `image` is uint8 [H, W, 3]."""
    check_array(name, image, (None, None, 3))
    if image.dtype != np.uint8:
        raise ValueError(f"`{name}` has dtype {image.dtype}, expected uint8; scale it to 0..255 and convert it")


def check_pose(name: str, pose: np.ndarray) -> None:
    """Raise `ValueError` unless `pose` is a finite 4 x 4 rigid motion (to 1e-4: it may come from float32)."""
    check_array(name, pose, (4, 4))
    rotation = pose[:3, :3].astype(np.float64)
    gap = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if gap > 1e-4 or np.linalg.det(rotation) < 0 or np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise ValueError(
            f"`{name}` is not a rigid motion (its rotation is off by {gap:.2g}), expected [R t; 0 1]; orthonormalise R"
        )
