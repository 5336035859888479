"""Whether two values are one to the last bit: every field, of whatever class, down to numbers and arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

import jax
import numpy as np


def differences(first: Any, second: Any, where: str = "value") -> Iterator[str]:
    """The ways to what differs, in kind, element type, order in memory, or any bit."""
    first, second = _result(first), _result(second)
    if type(first) is not type(second):
        yield f"{where}: {type(first).__name__}, {type(second).__name__}"
    elif dataclasses.is_dataclass(first) and not isinstance(first, type):
        for field in dataclasses.fields(first):
            yield from differences(getattr(first, field.name), getattr(second, field.name), f"{where}.{field.name}")
    elif isinstance(first, tuple | list):
        if len(first) != len(second):
            yield f"{where}: {len(first)} and {len(second)} entries"
        for row, (one, other) in enumerate(zip(first, second, strict=False)):
            yield from differences(one, other, f"{where}[{row}]")
    elif isinstance(first, dict):
        if list(first) != list(second):
            yield f"{where}: {list(first)}, {list(second)}"
        else:
            for key in first:
                yield from differences(first[key], second[key], f"{where}[{key!r}]")
    elif isinstance(first, np.ndarray | jax.Array | np.generic):
        yield from _array_differences(first, second, where)
    elif not (first == second or first != first) or str(first) != str(second):
        yield f"{where}: {first!r}, {second!r}"


def _result(value: Any) -> Any:
    return ("result", value.result()) if isinstance(value, Future) else value


def _array_differences(first: Any, second: Any, where: str) -> Iterator[str]:
    one, other = np.asarray(first), np.asarray(second)
    if (one.dtype, one.shape) != (other.dtype, other.shape):
        yield f"{where}: {one.dtype} {one.shape}, {other.dtype} {other.shape}"
    elif one.tobytes() != other.tobytes():
        yield f"{where}: {np.count_nonzero(one != other)} of {one.size} numbers differ"
    elif isinstance(first, np.ndarray) and one.size and one.strides != other.strides:
        yield f"{where}: strides {one.strides}, {other.strides}"
    elif isinstance(first, jax.Array) and first.weak_type != second.weak_type:
        yield f"{where}: one is weakly typed"
