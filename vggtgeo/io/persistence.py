"""Save values of known classes (states, maps, checkpoints, problems, scenes, cached arrays) in a file, and load them.

A file is a zip archive of two arrays of bytes. `header.npy` is JSON: the kind of the file, its version, plain facts
about it, the classes and their fields, a table of the named arrays, and the tree of values. `data.npy` has the bytes of
all arrays. A loaded value equals the saved one exactly, including element types, memory order (on which the rounding of
a sum depends), and which fields share an array.

Loading runs no code of the file: the file names classes, and the reader looks them up in its own list. Fields are set
without calling constructors, so that they are unchanged. The header is checked before any data are read, and zip's
checksums detect damage. A file of another version is an error.

In the tree, null, booleans, numbers and texts stand for themselves, and a JSON list is a tuple. All else is a JSON
object: `l` a list, `d` a dictionary, `c` and `v` an object (number of its class, values of its fields), `k` a class,
`t` an element type, `r` the result of a future. With the name of an array it is: `a` a numpy array, `s` a numpy scalar,
`b` bytes, `j` a JAX array, `w` a weakly typed JAX array.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vggtgeo.io.archives import MAX_BYTES, Archive, open_archive
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open

MAX_HEADER = 2**27
"""Maximum bytes of a header; that of a state of 100,000 frames has 64 MiB."""
HEADER, DATA = "header", "data"
REPAIR_HINT = "use an undamaged copy, or write it again"
_ELEMENTS = "biufU"
"""Kinds of elements that arrays may have: booleans, integers, floats, texts."""
_INVALID = (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError, OverflowError)
Tree = Any
"""A value of JSON."""


def by_name(classes: Iterable[type]) -> dict[str, type]:
    """Return classes by their short names; raise ValueError if two have the same name."""
    named: dict[str, type] = {}
    for kind in classes:
        if named.setdefault(kind.__name__, kind) is not kind:
            raise ValueError(f"classes must have different names, got `{kind.__name__}` twice")
    return named


@dataclasses.dataclass(frozen=True, eq=False)
class Format:
    """A kind of file.

    Fields: kind, a noun ("map"); version, increased when the classes change; classes, that values may have, by name;
    compressed, whether the data are compressed (then at most `MAX_BYTES` are read); hint, for the error about an
    unknown class.
    """

    kind: str
    version: int
    classes: Mapping[str, type]
    compressed: bool = False
    hint: str = ""

    def with_classes(self, more: Iterable[type]) -> Format:
        """Return the format with more classes; raise ValueError if two have the same name."""
        return dataclasses.replace(self, classes=by_name((*self.classes.values(), *more)))

    def write(self, path: Path, value: Any, facts: Mapping[str, Any] | None = None) -> None:
        """Write a value and plain facts about it, atomically.

        Raises:
            TypeError: a part of the value, which the message names, has an unknown class.

        """
        encoder = _Encoder(self)
        header = {"vggtgeo": self.kind, "version": self.version, "facts": dict(facts or {})}
        header |= {"tree": encoder.tree(value, ""), "classes": encoder.classes, "arrays": encoder.arrays}
        text = np.frombuffer(json.dumps(header).encode(), np.uint8)
        method = zipfile.ZIP_DEFLATED if self.compressed else zipfile.ZIP_STORED
        with atomic_open(path, "wb") as file, zipfile.ZipFile(file, "w", method) as archive:
            _write_bytes(archive, HEADER, [text])
            _write_bytes(archive, DATA, encoder.blocks)

    def read(self, path: Path, as_array: Callable[[np.ndarray], Any] = jnp.asarray) -> tuple[Any, dict[str, Any]]:
        """Return the value and the facts of a file.

        as_array: makes a JAX array from a numpy array. A forked process must not use JAX: give `numpy.asarray` there.

        Raises:
            InputError: the file is missing, damaged, too large, inconsistent, or of another kind or version.

        """
        header, data = self._parts(Path(path), with_data=True)
        try:
            decoder = _Decoder(self, header["classes"], header["arrays"], data.reshape(-1).view(np.uint8), as_array)
            return decoder.value(header["tree"]), header["facts"]
        except _INVALID as error:
            raise InputError(f"`{path}` is not a valid {self.kind}: {error}; {REPAIR_HINT}") from None

    def facts(self, path: Path) -> dict[str, Any]:
        """Return only the facts; raise InputError as `read`."""
        facts: dict[str, Any] = self._parts(Path(path), with_data=False)[0]["facts"]
        return facts

    def _parts(self, path: Path, with_data: bool) -> tuple[dict[str, Any], np.ndarray]:
        """Return the checked header, and the data, which are empty without `with_data`."""
        with open_archive(path, self._article) as archive:
            header = self._header(archive)
            limit = MAX_BYTES if self.compressed else path.stat().st_size
            data = archive.read([DATA], limit=limit)[DATA] if with_data else np.zeros(0, np.uint8)
        return header, data

    @property
    def _article(self) -> str:
        return f"{'an' if self.kind[0] in 'aeiou' else 'a'} {self.kind}"

    def _header(self, archive: Archive) -> dict[str, Any]:
        if set(archive.members) != {HEADER, DATA}:
            raise InputError(f"`{archive.path}` is not {self._article} of vggtgeo: it must have `header` and `data`")
        text = archive.read([HEADER], limit=MAX_HEADER)[HEADER].tobytes()
        try:
            header = dict(json.loads(text))
            kind, version, _ = (header[name] for name in ("vggtgeo", "version", "tree"))
            _, _, header["facts"] = list(header["classes"]), dict(header["arrays"]), dict(header["facts"])
        except _INVALID as error:
            raise InputError(
                f"`{archive.path}` is not {self._article} of vggtgeo: {error!s:.200}; {REPAIR_HINT}"
            ) from None
        if kind != self.kind:
            raise InputError(f"`{archive.path}` must be of kind {self.kind!r}, got {kind!r:.40}")
        if version != self.version:
            raise InputError(
                f"`{archive.path}` must have version {self.version}, got {version!r:.20}: use the program that wrote it"
            )
        return header


class _Encoder:
    """Encodes a value as JSON, a table of named arrays, and their bytes."""

    def __init__(self, layout: Format) -> None:
        self._kind = layout.kind
        self._names = {kind: name for name, kind in layout.classes.items()}
        self._numbers: dict[type, int] = {}
        self._seen: dict[int, str] = {}
        self._alive: list[Any] = []  # keeps arrays alive, so that their `id` is not used again
        self._size = 0
        self.classes: list[tuple[str, list[str]]] = []
        self.arrays: dict[str, list[Any]] = {}
        self.blocks: list[np.ndarray] = []

    def tree(self, value: Any, name: str) -> Tree:
        kind = type(value)
        if value is None or kind in (bool, int, float, str):
            return value
        if kind in self._names:
            return self._object(value, name)
        return self._items(value, name) if kind is tuple else self._tagged(value, name)

    def _tagged(self, value: Any, name: str) -> Tree:
        kind = type(value)
        if kind is list:
            return {"l": self._items(value, name)}
        if kind is dict and all(type(key) is str for key in value):
            return {"d": {key: self.tree(item, f"{name}.{key}" if name else key) for key, item in value.items()}}
        if kind is np.ndarray:
            return {"a": self._array(value, name, value)}
        if kind is bytes:
            return {"b": self._array(value, name, np.frombuffer(value, np.uint8))}
        if isinstance(value, np.generic | jax.Array):
            token = "s" if isinstance(value, np.generic) else "w" if value.weak_type else "j"
            return {token: self._array(value, name, np.asarray(value))}
        if isinstance(value, Future):
            return {"r": self.tree(value.result(), name)}
        if isinstance(value, np.dtype):
            return {"t": value.str}
        if isinstance(value, type) and value in self._names:
            return {"k": self._names[value]}
        raise TypeError(
            f"`{name}` must be of a type that a {self._kind} can hold, got {kind.__qualname__}: {value!r:.60}"
        )

    def _items(self, values: Sequence[Any], name: str) -> list[Tree]:
        return [self.tree(item, f"{name}[{number}]") for number, item in enumerate(values)]

    def _object(self, value: Any, name: str) -> Tree:
        kind = type(value)
        fields = [field.name for field in dataclasses.fields(kind)]
        if kind not in self._numbers:
            self._numbers[kind] = len(self.classes)
            self.classes.append((self._names[kind], fields))
        values = [self.tree(getattr(value, field), f"{name}.{field}" if name else field) for field in fields]
        return {"c": self._numbers[kind], "v": values}

    def _array(self, key: Any, name: str, values: np.ndarray) -> str:
        """Add an array, only once if several fields share it; return its name."""
        if id(key) in self._seen:
            return self._seen[id(key)]
        if values.dtype.kind not in _ELEMENTS:
            raise TypeError(f"`{name}` must be an array of numbers or texts, got {values.dtype}")
        strides = None if values.flags.c_contiguous else list(values.strides)
        self.arrays[name] = [values.dtype.str, self._size, list(values.shape), strides]
        block = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
        self.blocks.append(block)
        self._size += block.nbytes
        self._alive.append(key)
        self._seen[id(key)] = name
        return name


class _Decoder:
    """Decodes the value from a header and the bytes of its arrays."""

    def __init__(
        self,
        layout: Format,
        classes: Sequence[Any],
        arrays: Mapping[str, Any],
        data: np.ndarray,
        as_array: Callable[[np.ndarray], Any],
    ) -> None:
        self._known, self._hint, self._arrays, self._data = layout.classes, layout.hint, arrays, data
        self._classes = [self._checked(name, fields) for name, fields in classes]
        self._made: dict[tuple[str, str], Any] = {}
        self._from_array: dict[str, Callable[[np.ndarray], Any]] = {
            "a": lambda values: values,
            "s": lambda values: values[()],
            "b": lambda values: values.tobytes(),
            "j": as_array,
            "w": lambda values: _weakly_typed(values) if as_array is jnp.asarray else as_array(values),
        }

    def value(self, tree: Tree) -> Any:
        if isinstance(tree, list):
            return tuple(self.value(item) for item in tree)
        if not isinstance(tree, dict):
            return tree
        if tree.keys() == {"c", "v"}:
            return self._object(self._classes[tree["c"]], tree["v"])
        ((token, content),) = tree.items()
        if token in self._from_array:
            if (token, content) not in self._made:
                self._made[token, content] = self._from_array[token](self._values(content))
            return self._made[token, content]
        if token == "l":
            return [self.value(item) for item in content]
        if token == "d":
            return {str(key): self.value(item) for key, item in content.items()}
        if token == "k":
            return self._class(content)
        if token == "t":
            return _element_type("its type", content)
        if token == "r":
            return _finished(self.value(content))
        raise ValueError(f"it has the unknown token {token!r:.20}")

    def _class(self, name: str) -> type:
        if name not in self._known:
            raise ValueError(f"it has a value of the unknown class `{name!s:.60}`{self._hint}")
        return self._known[name]

    def _checked(self, name: str, fields: list[str]) -> type:
        kind = self._class(name)
        own = [field.name for field in dataclasses.fields(kind)]
        if own != list(fields):
            raise ValueError(f"`{name}` must have the fields {own}, got {fields} (written by another version)")
        return kind

    def _object(self, kind: type, values: Sequence[Tree]) -> Any:
        made: Any = object.__new__(kind)
        for field, item in zip(dataclasses.fields(kind), values, strict=True):
            object.__setattr__(made, field.name, self.value(item))
        return made

    def _values(self, name: str) -> np.ndarray:
        element, first, shape, strides = self._arrays[name]
        dtype = _element_type(f"array `{name}`", element)
        size = math.prod(shape) * dtype.itemsize
        values = self._data[first : first + size].copy().view(dtype).reshape(shape)
        return values if strides is None else _strided(values, strides)


def _element_type(name: str, element: Any) -> np.dtype[Any]:
    # Checked, since `numpy.dtype` would also evaluate names of records and other text.
    if not re.fullmatch(rf"[<>|=][{_ELEMENTS}]\d+", str(element)):
        raise ValueError(f"{name} must be of numbers, got {element!r:.60}")
    return np.dtype(element)


def _weakly_typed(values: np.ndarray) -> jax.Array:
    """Return a weakly typed array, which JAX makes only of Python numbers and of other weakly typed arrays."""
    weak = jnp.asarray(values.dtype.type(0).item())
    return jnp.broadcast_to(weak, values.shape).at[...].set(values)


def _finished(value: Any) -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(value)
    return future


def _strided(values: np.ndarray, strides: Sequence[int]) -> np.ndarray:
    """Return the same values with other strides, as in a view of a larger array."""
    steps = list(zip(strides, values.shape, strict=True))
    if not values.size:
        return values
    low = sum((size - 1) * step for step, size in steps if step < 0)
    high = sum((size - 1) * step for step, size in steps if step > 0)
    span = np.zeros(high - low + values.itemsize, np.uint8)
    made = np.ndarray(values.shape, values.dtype, span.data, -low, tuple(strides))
    made[...] = values
    return made


def _write_bytes(archive: zipfile.ZipFile, name: str, blocks: list[np.ndarray]) -> None:
    """Write one member block by block, so that the arrays of a map are not copied."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        size = sum(block.nbytes for block in blocks)
        np.lib.format.write_array_header_1_0(member, {"descr": "|u1", "fortran_order": False, "shape": (size,)})
        for block in blocks:
            member.write(block.data)
