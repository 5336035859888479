"""Any frozen value (dataclasses, modules of arrays, tuples, numbers) as JSON and a block of bytes, and back.

Exact to the bit: floats, element types, the order of arrays in memory (a sum depends on it), and which fields share one
array. Nothing that is read is executed: classes are those that the caller lists, a file names them by their short name,
and fields are set as they were, past constructors.

JSON says `null`, booleans, whole numbers, texts and finite floats as they are, and a tuple as a list. All else is an
object of one key: `f` (a float that is not finite), `l` (a list), `d` (a dictionary), `c` (the number of a class in the
list of classes; its fields under `v`), `k` (a class itself), `t` (an element type), `r` (the result of a future, which
is waited for; it is done when it is read), and, by its number in the list of
arrays, `a` (a numpy array), `s` (a numpy scalar), `b` (bytes), `j` (a JAX array), `w` (one that is weakly typed).
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.io.field_types import field_tests

Tree = Any
"""What JSON holds."""
KINDS = "biuf"
"""Element types that a file may hold: booleans, whole numbers, floats."""
SPREAD = 64
"""A view may leave out so many elements for each that it has (a column of a table, one channel of an image)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Packed:
    """tree: of JSON. classes: name and fields of each class in it. arrays: element type, first byte, shape, and strides
    in bytes (None: C order) of each array in the block. blocks: of bytes, to be joined.
    """

    tree: Tree
    classes: list[list[Any]]
    arrays: list[list[Any]]
    blocks: list[np.ndarray]

    @property
    def bytes(self) -> int:
        """Of all blocks."""
        return sum(block.nbytes for block in self.blocks)


def by_name(classes: Iterable[type]) -> dict[str, type]:
    """Classes by the short names that files call them."""
    found: dict[str, type] = {}
    for kind in classes:
        if found.setdefault(kind.__name__, kind) is not kind:
            raise ValueError(f"two classes are called `{kind.__name__}`")
    return found


def pack_value(value: Any, known: Mapping[str, type]) -> Packed:
    """`value` for a file; a class that is not among `known` is a TypeError that says where it is."""
    return _Packer(known).packed(value)


def unpack_value(
    tree: Tree, classes: Sequence[Any], arrays: Sequence[Any], block: np.ndarray, known: Mapping[str, type]
) -> Any:
    """The value that `pack_value` packed; block: uint8, all bytes.

    Raises:
        InputError: a class is not known or has other fields, or an array reaches beyond the block.
        ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError: the tree is none.

    """
    return _Unpacker(classes, arrays, block, known).value(tree)


class _Packer:
    def __init__(self, known: Mapping[str, type]) -> None:
        self._names = {kind: name for name, kind in known.items()}
        self._numbers: dict[type, int] = {}
        self._seen: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no `id` is used twice
        self._used = 0
        self._found = Packed(None, [], [], [])

    def packed(self, value: Any) -> Packed:
        return dataclasses.replace(self._found, tree=self._tree(value, "value"))

    def _tree(self, value: Any, where: str) -> Tree:
        kind = type(value)
        if value is None or kind in (bool, int, str):
            return value
        if kind is float:
            return value if math.isfinite(value) else {"f": str(value)}
        if kind is tuple:
            return [self._tree(item, where) for item in value]
        if kind in self._names:
            return self._fields(value, where)
        for test, pack in self._RARE:
            if test(value):
                return pack(self, value, where)
        raise TypeError(f"`{where}` is a {kind.__qualname__}, which no file of states can hold")

    def _fields(self, value: Any, where: str) -> Tree:
        kind = type(value)
        names = [field.name for field in dataclasses.fields(kind)]
        if kind not in self._numbers:
            self._numbers[kind] = len(self._found.classes)
            self._found.classes.append([self._names[kind], names])
        inside = [self._tree(getattr(value, name), f"{where}.{name}") for name in names]
        return {"c": self._numbers[kind], "v": inside}

    def _class(self, value: Any, where: str) -> Tree:
        if value not in self._names:
            raise TypeError(f"`{where}` is the class {value.__qualname__}, which no file of states can hold")
        return {"k": self._names[value]}

    def _dictionary(self, value: Any, where: str) -> Tree:
        if not all(type(key) is str for key in value):
            raise TypeError(f"`{where}` is a dictionary whose keys are no texts, which no file of states can hold")
        return {"d": {key: self._tree(item, f"{where}[{key!r}]") for key, item in value.items()}}

    def _jax(self, value: Any, where: str) -> Tree:
        return {"w" if value.weak_type else "j": self._array(value, where, np.asarray(value))}

    def _array(self, key: Any, where: str, values: np.ndarray) -> int:
        """Number of an array in the list; one that several fields share is there once."""
        if id(key) in self._seen:
            return self._seen[id(key)]
        if values.dtype.kind not in KINDS:
            raise TypeError(f"`{where}` is an array of {values.dtype}, which no file of states can hold")
        strides = None if values.flags.c_contiguous else list(values.strides)
        self._found.arrays.append([values.dtype.str, self._used, list(values.shape), strides])
        block = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
        self._found.blocks.append(block)
        self._used += block.nbytes
        self._kept.append(key)
        self._seen[id(key)] = len(self._found.arrays) - 1
        return self._seen[id(key)]

    _RARE: tuple[tuple[Callable[[Any], bool], Callable[[_Packer, Any, str], Tree]], ...] = (
        (lambda v: type(v) is np.ndarray, lambda self, v, at: {"a": self._array(v, at, v)}),
        (lambda v: isinstance(v, jax.Array), lambda self, v, at: self._jax(v, at)),
        (lambda v: isinstance(v, np.generic), lambda self, v, at: {"s": self._array(v, at, np.asarray(v))}),
        (lambda v: type(v) is bytes, lambda self, v, at: {"b": self._array(v, at, np.frombuffer(v, np.uint8))}),
        (lambda v: type(v) is list, lambda self, v, at: {"l": [self._tree(item, at) for item in v]}),
        (lambda v: type(v) is dict, lambda self, v, at: self._dictionary(v, at)),
        (lambda v: isinstance(v, np.dtype), lambda self, v, at: {"t": v.str}),
        (lambda v: isinstance(v, type), lambda self, v, at: self._class(v, at)),
        (lambda v: isinstance(v, Future), lambda self, v, at: {"r": self._tree(v.result(), at)}),
    )


class _Unpacker:
    def __init__(
        self, classes: Sequence[Any], arrays: Sequence[Any], block: np.ndarray, known: Mapping[str, type]
    ) -> None:
        self._known = known
        self._classes = [self._checked(name, fields) for name, fields in classes]
        self._arrays, self._block = arrays, block
        self._made: dict[tuple[str, int], Any] = {}

    def value(self, tree: Tree) -> Any:
        if isinstance(tree, list):
            return tuple(self.value(item) for item in tree)
        if not isinstance(tree, dict):
            return tree
        if tree.keys() == {"c", "v"}:
            return self._filled(tree)
        ((sign, content),) = tree.items()
        if sign in "asbjw":
            if (sign, content) not in self._made:
                self._made[sign, content] = _FROM_ARRAY[sign](self._values(content))
            return self._made[sign, content]
        return self._plain(sign, content)

    def _plain(self, sign: str, content: Any) -> Any:
        if sign == "f":
            return {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}[content]
        if sign == "l":
            return [self.value(item) for item in content]
        if sign == "d":
            return {str(key): self.value(item) for key, item in content.items()}
        if sign == "k":
            return self._class(content)
        if sign == "t":
            return _element_type(content)
        if sign == "r":
            return _done(self.value(content))
        raise ValueError(f"it holds {sign!r}, which means nothing")

    def _class(self, name: str) -> type:
        if name not in self._known:
            raise InputError(f"it holds a `{name}`, which this version does not know")
        return self._known[name]

    def _checked(self, name: str, fields: list[str]) -> type:
        kind = self._class(name)
        own = [field.name for field in dataclasses.fields(kind)]
        if own != list(fields):
            raise InputError(f"`{name}` has the fields {own}; the file has {fields}: another version wrote it")
        return kind

    def _filled(self, tree: Tree) -> Any:
        kind = self._classes[tree["c"]]
        made: Any = object.__new__(kind)
        for (name, (fits, words)), item in zip(field_tests(kind).items(), tree["v"], strict=True):
            value = self.value(item)
            if not fits(value):
                raise ValueError(f"`{name}` of a `{kind.__name__}` is {value!r:.60}, expected {words}")
            object.__setattr__(made, name, value)
        return made

    def _values(self, number: int) -> np.ndarray:
        kind, first, shape, strides = self._arrays[number]
        dtype = _element_type(kind)
        if not all(type(size) is int and size >= 0 for size in (first, *shape)):
            raise ValueError(f"array {number} has the place {first} and the shape {shape}")
        size = math.prod(shape) * dtype.itemsize
        if first + size > len(self._block):
            raise InputError(f"array {number} reaches beyond the {len(self._block)} bytes that are there")
        values = self._block[first : first + size].copy().view(dtype).reshape(shape)
        return values if strides is None else _laid_out(values, strides)


_FROM_ARRAY: dict[str, Callable[[np.ndarray], Any]] = {
    "a": lambda values: values,
    "s": lambda values: values[()],
    "b": lambda values: values.tobytes(),
    "j": jnp.asarray,
    # JAX makes a weak type of a Python number alone, or of an operation on weak types.
    "w": lambda values: jnp.broadcast_to(jnp.asarray(values.dtype.type(0).item()), values.shape).at[...].set(values),
}


def _done(value: Any) -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(value)
    return future


def _element_type(name: Any) -> np.dtype[Any]:
    if not re.fullmatch(rf"[<>|][{KINDS}]\d+", str(name)):  # NumPy also evaluates names of records, of any text
        raise InputError(f"it holds an array of {name!r:.60}; expected numbers")
    return np.dtype(name)


def _laid_out(values: np.ndarray, strides: Sequence[int]) -> np.ndarray:
    """The same values with other strides, as the view of some larger array had them."""
    steps = list(zip(strides, values.shape, strict=True))
    if not values.size:
        return values
    low = sum((size - 1) * step for step, size in steps if step < 0)
    high = sum((size - 1) * step for step, size in steps if step > 0)
    extent = high - low + values.itemsize
    if extent > SPREAD * values.nbytes:
        raise InputError(f"an array of {values.nbytes} bytes is spread over {extent}")
    made = np.ndarray(values.shape, values.dtype, np.zeros(extent, np.uint8).data, -low, tuple(strides))
    made[...] = values
    return made
