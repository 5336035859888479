"""Compiled functions whose traced program is kept between processes, beside JAX's compiled code.

JAX keeps what it has compiled, and finds it by the program; so each process traces and lowers every function again to
know what to look for. For a window's solve, its marginalisation, the solve of the whole map and its covariances that is
6 s of Python on every run, during which nothing else of the process runs. Here the program itself (StableHLO,
`jax.export`) is kept as well: 0.1 s each.

A kept program is one of this very code: its file is named after the text of all sources of the package, the versions of
what traces them, every static part and every shape. Where any of that has no lasting name (a function of a notebook, a
kernel of a user's own), nothing is kept. What is read is a program for XLA, no Python: nothing in it is executed but by
its call. `JAX_ENABLE_COMPILATION_CACHE=false` switches this off with JAX's own cache.
"""

from __future__ import annotations

import dataclasses
import hashlib
import types
from collections.abc import Callable, Hashable, Sequence
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from threading import Lock
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.export
import numpy as np

from vggtgeo.io.files import atomic_open

_Result = TypeVar("_Result")

LASTING = ("vggtgeo", "optimistix", "equinox", "lineax", "jaxlie", "jax", "numpy", "builtins")
"""Packages whose classes and functions are the same in another process, of the versions that the name holds."""
VERSIONS = ("optimistix", "equinox", "lineax", "jaxlie", "jax", "jaxlib", "numpy")


class KeptProgram(Generic[_Result]):
    """A pure function of pytrees, compiled for each structure and shape it is called with.

    As `equinox.filter_jit`, which it falls back on: for traced arguments, for arrays that lie elsewhere than on the
    first processor (a GPU, several devices), and where nothing can be kept. Only positional arguments.

    Args:
        function: traceable; its name and module are those of its program.
        result: of the same arguments, anything of the structure that `function` returns: what is in its arrays does not
            count.

    """

    def __init__(self, function: Callable[..., _Result], result: Callable[..., _Result]) -> None:
        self._function, self._result = function, result
        self._plain = eqx.filter_jit(function)
        self._programs: dict[Hashable, _Program] = {}
        self._lock = Lock()

    def __call__(self, *args: Any) -> _Result:
        leaves, structure = jax.tree.flatten(args)
        if any(isinstance(leaf, jax.core.Tracer) or _elsewhere(leaf) for leaf in leaves):
            return self._plain(*args)
        key = structure, _setting("enable_x64"), tuple(map(_kind_of, leaves))
        with self._lock:
            program = self._programs.setdefault(key, _Program())
        with program.lock:  # one thread prepares, and others of the same key wait for it
            if program.call is None:
                program.call = self._kept(args) or self._plain
        return program.call(*args)

    @property
    def prepared(self) -> int:
        """For how many structures and shapes it was called so far."""
        return len(self._programs)

    def _kept(self, args: tuple[Any, ...]) -> Callable[..., _Result] | None:
        """What runs the kept program for arguments like these; None where there is none and none can be made."""
        folder, named = _folder(), _lasting_name((self._function, args))
        if folder is None or named is None:
            return None
        arrays = [leaf for leaf in jax.tree.leaves(args) if _is_array(leaf)]
        result = jax.tree.structure(self._result(*args))
        path = folder / f"{self._function.__name__}-{_digest(named)}.stablehlo"
        exported = _read(path)
        if exported is None:
            exported = self._export(args, result, path)
        if exported is None or len(exported.in_avals) != len(arrays):
            return None
        # Not by `jit`, which would compile once more for arrays that such a program returned: they name their device.
        run = jax.jit(exported.call).lower(*arrays).compile()

        def call(*given: Any) -> _Result:
            here = [leaf for leaf in jax.tree.leaves(given) if _is_array(leaf)]
            found: _Result = jax.tree.unflatten(result, run(*here))
            return found

        return call

    def _export(self, args: tuple[Any, ...], result: Any, path: Path) -> jax.export.Exported | None:
        """The traced program, kept at `path`, as it is read from there; None where JAX cannot export it."""
        leaves, structure = jax.tree.flatten(args)
        arrays = [leaf for leaf in leaves if _is_array(leaf)]

        def flat(*given: jax.Array) -> list[jax.Array]:
            following = iter(given)
            every = [next(following) if _is_array(leaf) else leaf for leaf in leaves]
            found = self._function(*jax.tree.unflatten(structure, every))
            if jax.tree.structure(found) != result:
                raise NotImplementedError(f"{jax.tree.structure(found)} is returned, not {result}")
            return jax.tree.leaves(found)

        try:
            content = jax.export.export(jax.jit(flat))(*arrays).serialize()
        except (NotImplementedError, ValueError):  # a part that has no lasting form, or a result of another one
            return None
        try:
            with atomic_open(path, "wb") as file:
                file.write(content)
        except OSError:  # a full disk costs time alone
            return None
        return _read(path)


class _Program:
    """What is called for one key, once a thread has prepared it."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.call: Callable[..., Any] | None = None


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _elsewhere(leaf: Any) -> bool:
    """Whether an array lies on another device than the one that a kept program is compiled for, or on several."""
    return isinstance(leaf, jax.Array) and leaf.devices() != _first_device()


@cache
def _first_device() -> set[jax.Device]:
    return {jax.local_devices()[0]}


def _kind_of(leaf: Any) -> Hashable:
    """What a program depends on: of an array its type and shape, of any other leaf itself."""
    if _is_array(leaf):
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)
    return type(leaf), leaf


def _folder() -> Path | None:
    """Where programs are kept: beside JAX's compiled code, where that is kept on this machine for its processor."""
    place = _setting("compilation_cache_dir")
    if not _setting("enable_compilation_cache") or not place or "://" in place or jax.default_backend() != "cpu":
        return None
    return Path(place) / "programs"


def _read(path: Path) -> jax.export.Exported | None:
    try:
        return jax.export.deserialize(bytearray(path.read_bytes()))
    except Exception:  # noqa: BLE001 - whatever a damaged file brings about: it is made anew
        return None


def _digest(named: str) -> str:
    parts = [*(f"{name} {metadata.version(name)}" for name in VERSIONS), _sources(), _switches(), named]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def _switches() -> str:
    """What JAX traces differently under, beside the types of the arguments."""
    return str([_setting(name) for name in ("enable_x64", "default_matmul_precision", "numpy_dtype_promotion")])


def _setting(name: str) -> Any:
    return getattr(jax.config, f"jax_{name}")


@cache
def _sources() -> str:
    """Digest of the text of this package: a kept program is one of this code."""
    found = hashlib.sha256()
    for name in ("vggtgeo", "vggtgeo.solvers", "vggtgeo.models"):
        for folder in map(Path, import_module(name).__path__):
            for file in sorted(folder.rglob("*.py")):
                found.update(f"{name} {file.relative_to(folder)}\n".encode())
                found.update(file.read_bytes())
    return found.hexdigest()


def _lasting_name(value: Any) -> str | None:
    """All of a value but the numbers in its arrays, as a text that means the same in another process; None where a part
    of it has no such name.
    """
    if _is_array(value):
        return f"{value.dtype}{list(value.shape)}{'weak' if getattr(value, 'weak_type', False) else ''}"
    if value is None or isinstance(value, bool | int | float | str):
        return f"{type(value).__name__} {value!r}" if type(value).__module__ == "builtins" else None
    if isinstance(value, type | types.FunctionType):
        return _lasting_path(value)
    if type(value) in (tuple, list):
        return _joined(type(value).__name__, value)
    if type(value) is dict and all(isinstance(key, str) for key in value):
        return _joined(" ".join(map(repr, value)), list(value.values()))
    if isinstance(value, tuple) and hasattr(value, "_fields") and (path := _lasting_path(type(value))) is not None:
        return _joined(path, value)
    if dataclasses.is_dataclass(value) and (path := _lasting_path(type(value))) is not None:
        fields = [field.name for field in dataclasses.fields(value)]
        return _joined(f"{path} {' '.join(fields)}", [getattr(value, name) for name in fields])
    return None


def _joined(head: str, values: Sequence[Any]) -> str | None:
    parts = [_lasting_name(value) for value in values]
    return None if None in parts else f"{head} ({', '.join(map(str, parts))})"


def _lasting_path(named: type | types.FunctionType) -> str | None:
    """Module and name of a class or function of a package in `LASTING`; None of one made inside a function."""
    module, name = named.__module__, named.__qualname__
    return f"{module}:{name}" if module.split(".")[0] in LASTING and "<" not in name else None
