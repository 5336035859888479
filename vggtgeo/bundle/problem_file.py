"""Problems and solutions as `.npz` files."""

from __future__ import annotations

import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from vggtgeo.bundle.packing import Observations, SlotIndex, pack
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.solvers.kernels import Huber

LAYOUT: dict[str, tuple[str | int, ...]] = {
    "edges": ("E", 2),
    "T_init": ("N", 7),
    "k_init": (4,),
    "k_prior_sigma": (4,),
    **{"var_kf": ("D",), "var_uv": ("D", 2)},
    **{"d_init": ("D",), "d_prior": ("D",), "d_sigma": ("D",), "d_weight": ("D",)},
    **{"pt_edge": ("A",), "pt_var": ("A",), "pt_target": ("A", 2), "pt_weight": ("A",)},
    **{"ln_edge": ("B",), "ln_var": ("B",), "ln_abc": ("B", 3), "ln_weight": ("B",)},
    **{"alpha": (), "huber": ()},
}
"""Arrays of a problem and their shapes; the first array with a letter decides its size."""


def load_problem(path: Path, dtype: DTypeLike | None = None) -> tuple[Problem, State, SlotIndex]:
    """Read a problem: poses world -> camera `(qw, qx, qy, qz, tx, ty, tz)`, pixels, inverse depths in 1/m.

    dtype: float type of all arrays, as `vggtgeo.pack` takes it.

    Raises:
        InputError: the file is missing, is no `.npz`, lacks an array or holds one that does not fit.

    Example:
        >>> import vggtgeo as vg
        >>> from pathlib import Path
        >>> vg.load_problem(Path("no.npz"))
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no.npz` is no file; give the .npz of a bundle-adjustment problem

    """
    arrays = _read(Path(path))
    observations = Observations(
        edges=arrays["edges"].astype(int),
        host=arrays["var_kf"].astype(int),
        pixel=arrays["var_uv"],
        point_edge=arrays["pt_edge"].astype(int),
        point_landmark=arrays["pt_var"].astype(int),
        point_target=arrays["pt_target"],
        point_weight=arrays["pt_weight"],
        line_edge=arrays["ln_edge"].astype(int),
        line_landmark=arrays["ln_var"].astype(int),
        line_coefficients=arrays["ln_abc"],
        line_weight=arrays["ln_weight"],
        depth_mean=arrays["d_prior"],
        depth_sigma=arrays["d_sigma"],
        depth_weight=arrays["d_weight"],
        alpha=float(arrays["alpha"]),
        segment=arrays["var_segment"].astype(int) if "var_segment" in arrays else None,
    )
    if not arrays["huber"] > 0:
        raise InputError(f"array `huber` of `{path}` is {arrays['huber']}; it must be positive")
    return pack(
        observations,
        arrays["T_init"],
        arrays["k_init"],
        arrays["d_init"],
        intrinsics_sigma=arrays["k_prior_sigma"],
        kernel=Huber(jnp.asarray(float(arrays["huber"]), dtype)),
        dtype=dtype,
    )


def save_solution(path: Path, state: State, index: SlotIndex) -> None:
    """Write a solution as `.npz`, atomically: `T [N, 7]`, `k [4]`, `d [D]` in the conventions of the problem's file."""
    with atomic_open(path, "wb") as file:
        np.savez(
            file,
            T=np.asarray(state.poses.wxyz_xyz),
            k=np.asarray(state.intrinsics),
            d=index.gather(state.inverse_depth),
        )


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise InputError(f"`{path}` is no file; give the .npz of a bundle-adjustment problem")
    try:
        with open(path, "rb") as handle, np.load(handle) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"`{path}` cannot be read as .npz: {error}") from error
    missing = [name for name in LAYOUT if name not in arrays]
    if missing:
        raise InputError(f"`{path}` lacks the arrays {', '.join(missing)}; the layout is in docs/problem-file.md")
    _check_shapes(path, arrays)
    return arrays


def _check_shapes(path: Path, arrays: dict[str, np.ndarray]) -> None:
    sizes: dict[str | int, int] = {}
    for name, layout in LAYOUT.items():
        found = arrays[name]
        for axis, length in zip(layout, found.shape, strict=False):
            if isinstance(axis, str):
                sizes.setdefault(axis, length)
        expected = tuple(sizes.get(axis, axis) for axis in layout)
        if found.shape != expected:
            raise InputError(
                f"array `{name}` of `{path}` has shape {found.shape}; expected {expected}, see docs/problem-file.md"
            )
        if not (np.issubdtype(found.dtype, np.number) or found.dtype == bool):
            raise InputError(f"array `{name}` of `{path}` holds {found.dtype}; expected numbers")
