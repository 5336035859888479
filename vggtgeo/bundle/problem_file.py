"""Problems and solutions as `.npz` files."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.observed import check_tied
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.packing_checks import check_dtype
from vggtgeo.bundle.padding import SlotIndex
from vggtgeo.bundle.pair_checks import check_kinds
from vggtgeo.bundle.precision import check_precision
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.saved_checks import check_problem
from vggtgeo.bundle.saved_modules import describe, restore
from vggtgeo.io.archives import Archive, ArrayHeader, read_archive
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.io.given import check_kind, path_of
from vggtgeo.solvers.kernels import Huber

DESCRIPTION = "description"
"""Array of a saved problem that says, in JSON, which class each part is and where its arrays are."""
VERSION = 1

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


OPTIONAL: dict[str, tuple[str | int, ...]] = {"var_segment": ("D",)}
"""Arrays that a problem may lack."""
INDICES = ("edges", "var_kf", "pt_edge", "pt_var", "ln_edge", "ln_var", "var_segment")
_OF_ROWS = ("part", "step")
"""Arrays of the index of a problem in which a keyframe has several rows of landmarks."""
_SAVED = ("problem/", "state/", "index/")
"""How the arrays of a saved problem begin."""


def load_problem(
    path: Path, dtype: DTypeLike | None = None, *, terms: Sequence[type] = ()
) -> tuple[Problem, State, SlotIndex]:
    """Read a problem: flat lists as other programs write them, or what `save_problem` wrote.

    Args:
        path: `.npz`; docs/reference/problem-file.md has both layouts.
        dtype: float type of all arrays, as `vggtgeo.pack` takes it.
        terms: classes of your own that a saved problem holds: terms, kernels, a camera. A file only names them; no code
            in it is run.

    Raises:
        InputError: the file is missing, is no `.npz`, lacks an array, holds one that does not fit, or names a class
            that is neither the package's nor given.

    Example:
        >>> import vggtgeo as vg
        >>> from pathlib import Path
        >>> vg.load_problem(Path("no.npz"))
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no.npz` is no file; give that of a bundle-adjustment problem

    """
    path = path_of("path", path)
    if dtype is not None:
        check_dtype(dtype)
    if not isinstance(terms, list | tuple) or not all(isinstance(kind, type) for kind in terms):
        raise InputError(f"`terms` is {terms!r:.60}; expected a list of classes, as [PositionFix]")
    arrays = _read(path)
    if DESCRIPTION in arrays:
        return _restored(path, arrays, terms, dtype)
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
    start = arrays["T_init"], arrays["k_init"], arrays["d_init"]
    try:
        check_precision({"huber": arrays["huber"]}, dtype, positive=("huber",))
        kernel = Huber(jnp.asarray(float(arrays["huber"]), dtype))
        packed = pack(observations, *start, intrinsics_sigma=arrays["k_prior_sigma"], kernel=kernel, dtype=dtype)
        check_tied(observations, len(arrays["T_init"]))
    except InputError as error:
        raise InputError(f"`{path}`: {error}") from error
    return packed


def load_arrays(path: Path, terms: Sequence[type] = ()) -> tuple[Problem, State, SlotIndex]:
    """What `save_problem` wrote, with leaves of numpy and without JAX: for the workers of a data loader.

    Raises:
        InputError: as `load_problem`.

    """
    arrays = _read(path)
    if DESCRIPTION not in arrays:
        raise InputError(f"`{path}` is no problem that `save_problem` wrote")
    return _restored(path, arrays, terms, None, np.asarray)


def save_problem(path: Path, problem: Problem, state: State, index: SlotIndex) -> None:
    """Write a problem with all its terms, kernels and its camera, a state and where the landmarks went, as `.npz`.

    `load_problem` gives the same leaves back, bit by bit. The file is written atomically and holds no pickles.

    Raises:
        InputError: they are not a problem, a state and an index, or a term holds something that is no array, number or
            text.

    Example (with `problem, initial, index = vg.simulate_window().pack()`):
        >>> import tempfile
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     vg.save_problem(Path(folder) / "window.npz", problem, initial, index)
        ...     again, start, _ = vg.load_problem(Path(folder) / "window.npz")
        >>> bool(vg.energy(again, start) == vg.energy(problem, initial))
        True

    """
    check_kinds(problem, state)
    check_kind("index", index, SlotIndex, "a `SlotIndex`, the third of what `vggtgeo.pack` gives")
    arrays: dict[str, np.ndarray] = {}
    parts = {"problem": problem, "state": state}
    description = {name: describe(part, name, arrays) for name, part in parts.items()}
    whole = {"version": VERSION, "index": list(index.shape), **description}
    for name in ("host", "slot", "edge", *_OF_ROWS):
        if getattr(index, name) is not None:
            arrays[f"index/{name}"] = getattr(index, name)
    with atomic_open(path, "wb") as file:
        named: dict[str, Any] = {DESCRIPTION: np.array(json.dumps(whole)), **arrays}
        np.savez_compressed(file, **named)


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
    """The arrays of either layout, and no others."""
    return read_archive(path, "a bundle-adjustment problem", _saved_or_flat)


def _saved_or_flat(archive: Archive) -> dict[str, np.ndarray]:
    if DESCRIPTION in archive:
        found = [name for name in archive.members if name == DESCRIPTION or name.startswith(_SAVED)]
        return archive.read(found, lambda headers: None)
    missing = [name for name in LAYOUT if name not in archive]
    if missing:
        raise InputError(
            f"`{archive.path}` lacks the arrays {', '.join(missing)}; the layout is in docs/reference/problem-file.md"
        )
    optional = [name for name in OPTIONAL if name in archive]
    return archive.read([*LAYOUT, *optional], lambda headers: _check_flat(archive.path, headers))


def _restored(
    path: Path,
    arrays: dict[str, np.ndarray],
    terms: Sequence[type],
    dtype: DTypeLike | None,
    as_array: Callable[..., Any] = jnp.asarray,
) -> tuple[Problem, State, SlotIndex]:
    try:
        whole = json.loads(str(arrays[DESCRIPTION]))
        if whole["version"] != VERSION:
            raise InputError(f"it has the version {whole['version']}; this program reads {VERSION}")
        problem, state = (restore(whole[name], arrays, terms, dtype, as_array) for name in ("problem", "state"))
        host, slot, edge = (arrays[f"index/{name}"] for name in ("host", "slot", "edge"))
        rows, edges, slots = map(int, whole["index"])
        index = SlotIndex(host, slot, edge, (rows, edges, slots), *(arrays.get(f"index/{name}") for name in _OF_ROWS))
        check_problem(problem, state, index)
    except InputError as error:
        raise InputError(f"`{path}` cannot be read as a problem: {error}") from error
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise InputError(f"`{path}` is no problem that `save_problem` wrote, or was changed since: {error}") from error
    return problem, state, index


def _check_flat(path: Path, found: Mapping[str, ArrayHeader]) -> None:
    """Shapes and element types that the layout asks for, known before the arrays are read."""
    sizes: dict[str | int, int] = {}
    for name, layout in {**LAYOUT, **OPTIONAL}.items():
        if name not in found:
            continue
        header = found[name]
        for axis, length in zip(layout, header.shape, strict=False):
            if isinstance(axis, str):
                sizes.setdefault(axis, length)
        expected = tuple(sizes.get(axis, axis) for axis in layout)
        if header.shape != expected:
            raise InputError(
                f"array `{name}` of `{path}` has shape {header.shape}; expected {expected}, see "
                "docs/reference/problem-file.md"
            )
        kinds, words = ("iu", "whole numbers") if name in INDICES else ("iufb", "numbers")
        if header.dtype.kind not in kinds:
            raise InputError(f"array `{name}` of `{path}` holds {header.dtype}; expected {words}")
    if not sizes["N"] or not sizes["D"]:
        raise InputError(
            f"`{path}` has {sizes['N']} keyframes and {sizes['D']} landmarks; expected at least one of each"
        )
