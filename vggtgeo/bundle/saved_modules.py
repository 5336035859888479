"""Any module of arrays (a problem with its terms and kernels) as named arrays and a description in JSON, and back.

Nothing that is read is executed: a file names its classes, and they are taken from the package or from those that the
caller passes, never imported from elsewhere. Fields are set as they were written, past constructors and converters, so
that what is read is what was saved.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.dtypes import canonicalize_dtype
from jax.typing import DTypeLike

from vggtgeo.bundle.precision import check_precision
from vggtgeo.bundle.problem import Edges, Problem, State
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry.cameras import AbstractCamera
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.kernels import AbstractKernel

Description = Any
"""What JSON holds: `{"array": name}`, `{"class": path, "fields": {...}}`, `{"type": path}`, `{"list": [...]}`,
`{"tuple": [...]}`, `{"dict": {...}}` or `{"value": ...}`."""

_KINDS = (AbstractTerm, AbstractKernel, AbstractCamera, Problem, Edges, State)
_HOMES = ("vggtgeo.bundle.terms.", "vggtgeo.bundle.problem", "vggtgeo.solvers.kernels", "vggtgeo.geometry.cameras")
"""Modules of the package that a file may name."""
_PLAIN = (bool, int, float, str, type(None))


def describe(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Description:
    """The description of `value`; its arrays are added to `arrays` under names that begin with `name`."""
    if eqx.is_array(value) or isinstance(value, np.ndarray):
        if name in arrays:
            raise InputError(f"two terms of the problem have one name: there is a second array `{name}`")
        arrays[name] = np.asarray(value)
        return {"array": name}
    if isinstance(value, _PLAIN):
        return {"value": value}
    if isinstance(value, type):
        return {"type": path_of(value)}
    if isinstance(value, list | tuple):
        kind = "list" if isinstance(value, list) else "tuple"
        return {kind: [describe(item, f"{name}/{_label(item, i)}", arrays) for i, item in enumerate(value)]}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": {key: describe(item, f"{name}/{key}", arrays) for key, item in value.items()}}
    if dataclasses.is_dataclass(value):
        members = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        inside = {key: describe(item, f"{name}/{key}", arrays) for key, item in members.items()}
        return {"class": path_of(type(value)), "fields": inside}
    raise InputError(f"`{name}` is {value!r:.60}; only arrays, modules of arrays, numbers and texts can be saved")


def restore(
    description: Description,
    arrays: Mapping[str, np.ndarray],
    own: Sequence[type],
    dtype: DTypeLike | None,
    as_array: Callable[..., Any] = jnp.asarray,
) -> Any:
    """What `describe` described. Float arrays become `dtype` (None: JAX's own for what is wider).

    as_array: `numpy.asarray` for leaves of numpy, made without a word to JAX's device: what a process does that was
    forked from one that uses JAX, which would wait for threads that it does not have.
    """
    ((kind, content),) = ((k, v) for k, v in description.items() if k != "fields")
    again = lambda part: restore(part, arrays, own, dtype, as_array)
    if kind == "array":
        if content not in arrays:
            raise InputError(f"the array `{content}` is missing")
        values = arrays[content]
        floating = np.issubdtype(values.dtype, np.floating)
        if floating:
            check_precision({content: values}, dtype)
        return as_array(values, canonicalize_dtype(dtype or values.dtype if floating else values.dtype))
    if kind == "value":
        return content
    if kind in ("list", "tuple"):
        return [again(part) for part in content] if kind == "list" else tuple(again(part) for part in content)
    if kind == "dict":
        return {key: again(part) for key, part in content.items()}
    found = find_class(content, own)
    return found if kind == "type" else _filled(found, {key: again(v) for key, v in description["fields"].items()})


def path_of(kind: type) -> str:
    """`module:name` of a class, as files name it."""
    return f"{kind.__module__}:{kind.__qualname__}"


def find_class(path: str, own: Sequence[type]) -> type:
    """The class that a file names: one of the package's, or one of `own`.

    Raises:
        InputError: another one.

    """
    known = {path_of(kind): kind for kind in (*own, jaxlie.SE3, jaxlie.SO3)}
    if path in known:
        return known[path]
    module, _, name = path.partition(":")
    # A class of a script or notebook has no lasting home: there its name alone counts.
    scripted = [kind for kind in own if kind.__qualname__ == name and "__main__" in (module, kind.__module__)]
    if len(scripted) == 1:
        return scripted[0]
    if module.startswith(_HOMES):
        try:
            found = getattr(importlib.import_module(module), name, None)
        except ImportError:
            found = None
        if isinstance(found, type) and issubclass(found, _KINDS):
            return found
        raise InputError(f"`{path}` is no class of this version of vggtgeo")
    raise InputError(
        f"`{path}` is no class of vggtgeo, and a file's code is never run: import the class and give it, as "
        f"`load_problem(path, terms=[{name.rpartition('.')[2]}])`"
    )


def _filled(kind: type, values: Mapping[str, Any]) -> Any:
    names = {field.name for field in dataclasses.fields(kind)}
    # A field that came later and may be absent: files that were written before it do not name it.
    later = {field.name: None for field in dataclasses.fields(kind) if field.default is None}
    values = {**later, **values}
    if names != values.keys():
        raise InputError(
            f"`{path_of(kind)}` has the fields {sorted(names)}; the file gives {sorted(values)}: it was written by "
            "another version of the class"
        )
    made: Any = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def _label(item: Any, number: int) -> str:
    """Terms by their name: the arrays of a file are then `terms/points/target`, say."""
    return item.name if isinstance(item, AbstractTerm) else str(number)
