"""Problems and solutions as files."""

from __future__ import annotations

import dataclasses
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.dtypes import canonicalize_dtype
from jax.typing import DTypeLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.bundle import terms as term_package
from vggtgeo.bundle.checks import check_dtype, check_kinds
from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import SlotIndex
from vggtgeo.bundle.problem import Edges, Problem, State, Terms
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import camera_models as cameras
from vggtgeo.io.archives import Archive, ArrayHeader, open_archive
from vggtgeo.io.argument_checks import check_kind, path_of
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.io.persistence import DATA, HEADER, Format, by_name
from vggtgeo.solvers.kernels import Barron, Cauchy, GemanMcClure, Huber, Square

PROBLEM_CLASSES: tuple[type, ...] = (
    *(Problem, Terms, State, Edges, SlotIndex, jaxlie.SE3, jaxlie.SO3),
    *(Square, Huber, Cauchy, GemanMcClure, Barron),
    *(cameras.Pinhole, cameras.RadialTangential, cameras.KannalaBrandt),
    *map(cameras.with_shared_focal, (cameras.Pinhole, cameras.RadialTangential, cameras.KannalaBrandt)),
)
"""Classes of the package that a saved problem may have, besides those of `bundle/terms/`."""
PROBLEM = Format("problem", 4, by_name(PROBLEM_CLASSES), True, ": pass your own classes as `terms`")

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


def load_problem(
    path: Path, dtype: DTypeLike | None = None, *, terms: Sequence[type] = ()
) -> tuple[Problem, State, SlotIndex]:
    """Load a problem: flat lists of another program, or a file of `save_problem`.

    Args:
        path: `.npz`; docs/reference/problem-file.md describes both layouts.
        dtype: float type of all arrays, as in `vggtgeo.pack`.
        terms: your own classes that a saved problem has: terms, kernels, a camera. A file only names classes; no code
            in it is executed.

    Raises:
        InputError: the file is missing or damaged, an array is missing or invalid, or a class is neither the
            package's nor in `terms`.

    Example:
        >>> import vggtgeo as vg
        >>> from pathlib import Path
        >>> vg.load_problem(Path("no.npz"))
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no.npz` does not exist or is not a file; give the file of a problem

    """
    path = path_of("path", path)
    if dtype is not None:
        check_dtype(dtype)
    with open_archive(path, "a problem") as archive:
        arrays = _flat(archive)
    if not arrays:
        return _load_saved(path, terms, lambda name, values: _as_jax(path, name, values, dtype))
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
    intrinsics = Intrinsics(arrays["k_init"], prior_sigma=arrays["k_prior_sigma"])
    try:
        kernel = Huber(jnp.asarray(float(arrays["huber"]), dtype))
        seen = dataclasses.replace(observations, kernel=kernel)
        packed = pack(seen, arrays["T_init"], intrinsics, arrays["d_init"], dtype=dtype)
        _check_connected(observations, len(arrays["T_init"]))
    except ValueError as error:
        raise InputError(f"`{path}`: {error}") from error
    return packed


def load_arrays(path: Path, terms: Sequence[type] = ()) -> tuple[Problem, State, SlotIndex]:
    """Load a file of `save_problem` with numpy leaves and without using JAX, for the workers of a data loader.

    Raises:
        InputError: as `load_problem`.

    """
    return _load_saved(path, terms, lambda name, values: values)


def save_problem(path: Path, problem: Problem, state: State, index: SlotIndex) -> None:
    """Save a problem with all its terms, kernels and its camera, a state, and where the landmarks are, atomically.

    `load_problem` returns the same leaves, bit by bit. The file has no pickles.

    Raises:
        InputError: an argument has another type, or a term holds something that is not an array, number or text.

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
    check_kind("index", index, SlotIndex, "a `SlotIndex`, the third result of `vggtgeo.pack`")
    value = {"problem": problem, "state": state, "index": index}
    try:
        PROBLEM.with_classes(_classes(problem)).write(path, value)
    except (TypeError, ValueError) as error:
        raise InputError(str(error)) from None


def save_solution(path: Path, state: State, index: SlotIndex) -> None:
    """Save a solution as `.npz`, atomically: `T [N, 7]`, `k [4]`, `d [D]` in the conventions of the flat lists."""
    with atomic_open(path, "wb") as file:
        np.savez(
            file,
            T=np.asarray(state.poses.wxyz_xyz),
            k=np.asarray(state.intrinsics),
            d=index.gather(state.inverse_depth),
        )


def _package_terms() -> list[type]:
    """Return the classes of terms in `bundle/terms/`, so that a new file there is all that a new residual needs."""
    # Found by listing the folder: a list here would be forgotten by the author of a new term.
    names = [f"{term_package.__name__}.{found.name}" for found in pkgutil.iter_modules(term_package.__path__)]
    kinds = [kind for name in names for kind in vars(import_module(name)).values() if isinstance(kind, type)]
    return [kind for kind in kinds if issubclass(kind, AbstractTerm) and kind.__module__ in names]


def _classes(value: Any) -> Iterator[type]:
    """Yield the classes in a tree of modules."""
    if isinstance(value, type):
        yield value
    elif dataclasses.is_dataclass(value):
        yield type(value)
        for field in dataclasses.fields(value):
            yield from _classes(getattr(value, field.name))
    elif isinstance(value, list | tuple | dict):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _classes(item)


def _flat(archive: Archive) -> dict[str, np.ndarray]:
    """Read the arrays of flat lists; none if the file is one of `save_problem`."""
    if {HEADER, DATA} <= archive.members.keys():
        return {}
    missing = [name for name in LAYOUT if name not in archive]
    if missing:
        raise InputError(
            f"the arrays {', '.join(missing)} are missing in `{archive.path}`; see docs/reference/problem-file.md"
        )
    optional = [name for name in OPTIONAL if name in archive]
    return archive.read([*LAYOUT, *optional], lambda headers: _check_flat(archive.path, headers))


def _load_saved(
    path: Path, terms: Sequence[type], convert: Callable[[str, np.ndarray], Any]
) -> tuple[Problem, State, SlotIndex]:
    try:
        models = [kind for kind in terms if issubclass(kind, cameras.AbstractCamera)]
        shared = map(cameras.with_shared_focal, filter(cameras.has_two_focal_lengths, models))
        layout = PROBLEM.with_classes((*_package_terms(), *terms, *shared))
    except ValueError as error:
        raise InputError(f"`terms`: {error}") from None
    saved, _ = layout.read(path, np.asarray)
    try:
        problem, state, index = (saved[name] for name in ("problem", "state", "index"))
        check_kinds(problem, state)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"`{path}` is not a valid problem: {error!r}") from error
    named = {"problem": problem, "state": state}
    leaf = lambda place, values: convert(jax.tree_util.keystr(place, simple=True, separator="."), np.asarray(values))
    named = jax.tree_util.tree_map_with_path(leaf, named)
    return named["problem"], named["state"], index


def _as_jax(path: Path, name: str, values: np.ndarray, dtype: DTypeLike | None) -> jax.Array:
    """Convert floats to `dtype` (None: JAX's own), other arrays as they are."""
    if not np.issubdtype(values.dtype, np.floating):
        return jnp.asarray(values, canonicalize_dtype(values.dtype))
    return jnp.asarray(values, canonicalize_dtype(dtype or values.dtype))


def _check_flat(path: Path, found: Mapping[str, ArrayHeader]) -> None:
    """Check shapes and element types before the arrays are read."""
    sizes: dict[str | int, int] = {}
    for name, layout in {**LAYOUT, **OPTIONAL}.items():
        if name not in found:
            continue
        header = found[name]
        for axis, length in zip(layout, header.shape, strict=False):
            if isinstance(axis, str):
                sizes.setdefault(axis, length)
        expected = tuple(sizes.get(axis, axis) for axis in layout)
        kinds, words = ("iu", "integers") if name in INDICES else ("iufb", "numbers")
        if header.shape != expected or header.dtype.kind not in kinds:
            raise InputError(
                f"array `{name}` of `{path}` must be {words} of shape {expected}, got {header.dtype} {header.shape}; "
                "see docs/reference/problem-file.md"
            )


def _check_connected(observations: Observations, keyframes: int) -> None:
    """Raise InputError unless matches of positive weight connect all keyframes; others would not be determined."""
    used = [
        observations.point_edge[observations.point_weight > 0],
        observations.line_edge[observations.line_weight > 0],
    ]
    pairs = observations.edges[np.unique(np.concatenate(used))]
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(keyframes, keyframes))
    _, component = connected_components(graph, directed=False)
    loose = np.flatnonzero(component != component[0])
    if len(loose):
        raise InputError(
            f"keyframe {loose[0]} is not connected to keyframe 0 by matches of positive weight ({len(loose)} of "
            f"{keyframes} keyframes are not): remove them, or solve each connected component separately"
        )
