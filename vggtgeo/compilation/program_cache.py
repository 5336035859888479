"""Compiled functions whose traced programs are cached on disk, beside JAX's compiled code.

JAX finds compiled code by the program, so each process traces and lowers every function again: 6 s of Python per run
for the solve of a window, its marginalisation, the solve of the map and its covariances. Here the program itself
(StableHLO, by `jax.export`) is cached as well, which takes 0.1 s each.

The file name is a digest of all sources of the package, the versions of the packages that trace, every static part and
every shape. A function or kernel without a lasting name (of a notebook, for example) is not cached. A cached program is
code for XLA, not Python, and runs only when it is called. `JAX_ENABLE_COMPILATION_CACHE=false` disables this cache
together with JAX's own.
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
from jax.typing import DTypeLike

from vggtgeo.io.files import atomic_open
from vggtgeo.io.process import return_freed_memory

_Result = TypeVar("_Result")

LASTING = ("vggtgeo", "optimistix", "equinox", "lineax", "jaxlie", "jax", "numpy", "builtins")
"""Packages whose classes and functions are the same in other processes, given their versions."""
VERSIONS = ("optimistix", "equinox", "lineax", "jaxlie", "jax", "jaxlib", "numpy")


class CachedProgram(Generic[_Result]):
    """A pure function of pytrees, compiled for each structure and shape it is called with.

    Falls back on `equinox.filter_jit` for traced arguments, for arrays on other devices than the first CPU, and where
    nothing can be cached. Only positional arguments.

    Args:
        function: traceable; its name and module identify its program.
        result: takes the same arguments, and returns any value with the structure of the function's result.

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
        with program.lock:  # one thread prepares, others with the same key wait
            if program.call is None:
                program.call = self._cached(args) or self._plain
        return program.call(*args)

    def _cached(self, args: tuple[Any, ...]) -> Callable[..., _Result] | None:
        """Return a call of the cached program for such arguments; None if there is none and it cannot be cached."""
        folder, named = _folder(), _lasting_name((self._function, args))
        if folder is None or named is None:
            return None
        arrays = [leaf for leaf in jax.tree.leaves(args) if _is_array(leaf)]
        result = jax.tree.structure(eqx.filter_eval_shape(self._result, *args))
        path = folder / f"{self._function.__name__}-{_digest(named)}.stablehlo"
        exported = _read(path)
        if exported is None:
            exported = self._export(args, result, path)
        if exported is None or len(exported.in_avals) != len(arrays):
            return None
        # Not `jit`, which would compile again for arrays that such a program returned: they name their device.
        run = jax.jit(exported.call).lower(*arrays).compile()
        return_freed_memory()  # hundreds of MB after a compilation

        def call(*given: Any) -> _Result:
            here = [leaf for leaf in jax.tree.leaves(given) if _is_array(leaf)]
            found: _Result = jax.tree.unflatten(result, run(*here))
            return found

        return call

    def _export(self, args: tuple[Any, ...], result: Any, path: Path) -> jax.export.Exported | None:
        """Trace the program and cache it at `path`; None if JAX cannot export it."""
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
        except (NotImplementedError, ValueError):  # a part cannot be exported, or the structure differs
            return None
        try:
            with atomic_open(path, "wb") as file:
                file.write(content)
        except OSError:  # a full disk costs only time
            return None
        return _read(path)


def to_device(values: Any, dtype: DTypeLike | None = None) -> jax.Array:
    """Return values of NumPy as an array of JAX, without the program that `jnp.asarray` compiles for each shape."""
    found: jax.Array = jax.device_put(np.asarray(values, dtype))
    return found


class _Program:
    """The function called for one key, once a thread has prepared it."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.call: Callable[..., Any] | None = None


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _elsewhere(leaf: Any) -> bool:
    """Return whether an array is on another device than the first, or on several."""
    return isinstance(leaf, jax.Array) and leaf.devices() != _first_device()


@cache
def _first_device() -> set[jax.Device]:
    return {jax.local_devices()[0]}


def _kind_of(leaf: Any) -> Hashable:
    """Return what a program depends on: type and shape of an array, any other leaf itself."""
    if _is_array(leaf):
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)
    return type(leaf), leaf


def _folder() -> Path | None:
    """Return the folder of cached programs, beside JAX's compiled code on this machine; None without one."""
    place = _setting("compilation_cache_dir")
    if not _setting("enable_compilation_cache") or not place or "://" in place or jax.default_backend() != "cpu":
        return None
    return Path(place) / "programs"


def _read(path: Path) -> jax.export.Exported | None:
    try:
        return jax.export.deserialize(bytearray(path.read_bytes()))
    except Exception:  # noqa: BLE001 - a damaged file may raise anything, and is written again
        return None


def _digest(named: str) -> str:
    # The settings of JAX that change what is traced.
    switches = str([_setting(name) for name in ("enable_x64", "default_matmul_precision", "numpy_dtype_promotion")])
    parts = [*(f"{name} {metadata.version(name)}" for name in VERSIONS), _sources(), switches, named]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def _setting(name: str) -> Any:
    return getattr(jax.config, f"jax_{name}")


@cache
def _sources() -> str:
    """Return a digest of the sources of this package."""
    found = hashlib.sha256()
    for name in ("vggtgeo", "vggtgeo.solvers", "vggtgeo.models"):
        for folder in map(Path, import_module(name).__path__):
            for file in sorted(folder.rglob("*.py")):
                found.update(f"{name} {file.relative_to(folder)}\n".encode())
                found.update(file.read_bytes())
    return found.hexdigest()


def _lasting_name(value: Any) -> str | None:
    """Return a value without the numbers in its arrays, as a text that means the same in other processes; None if a
    part has no such name.
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
    """Return module and name of a class or function in `LASTING`; None if it was made inside a function."""
    module, name = named.__module__, named.__qualname__
    return f"{module}:{name}" if module.split(".")[0] in LASTING and "<" not in name else None
