"""Whether a value is of the type that a dataclass states for its field, for files, which set fields past constructors.

Types that say more than a class can (shapes of arrays, functions, protocols) are not asked for more than the class.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np

Test = Callable[[Any], bool]
_CONCRETE = ("builtins", "numpy", "concurrent.futures._base", "jaxlib._jax")
_NUMBERS: dict[Any, tuple[type, ...]] = {
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (float, int, np.floating, np.integer),
}
"""Python's numbers may be those of numpy; True is a whole number to Python, and to nobody else."""


@cache
def field_tests(kind: type) -> Mapping[str, tuple[Test, str]]:
    """By the name of each field of a dataclass: whether a value is of its type, and the type in words."""
    try:
        stated = typing.get_type_hints(kind)
    except (NameError, TypeError):  # a name that only type checkers see
        stated = {}
    names = [entry.name for entry in dataclasses.fields(kind)]
    return {name: (_test(stated.get(name, Any)), _words(stated.get(name, Any))) for name in names}


def _words(stated: Any) -> str:
    return stated.__name__ if isinstance(stated, type) else str(stated).replace("typing.", "").replace(" | ", " or ")


def _test(stated: Any) -> Test:
    origin, inside = typing.get_origin(stated), typing.get_args(stated)
    if stated in _NUMBERS:
        allowed, refused = _NUMBERS[stated], () if stated is bool else (bool, np.bool_)
        return lambda value: isinstance(value, allowed) and not isinstance(value, refused)
    if origin in (typing.Union, types.UnionType):
        tests = [_test(one) for one in inside]
        return lambda value: any(test(value) for test in tests)
    if origin is tuple:
        return _test_of_tuple(inside)
    if origin is Mapping:
        key, item = map(_test, inside)
        return lambda value: isinstance(value, Mapping) and all(key(one) and item(two) for one, two in value.items())
    kind = getattr(stated, "array_type", origin or stated)  # of an array of jaxtyping, the class alone
    if isinstance(kind, type) and (kind.__module__ in _CONCRETE or dataclasses.is_dataclass(kind)):
        return lambda value: isinstance(value, kind)
    return lambda value: True


def _test_of_tuple(inside: tuple[Any, ...]) -> Test:
    if len(inside) == 2 and inside[1] is ...:
        each = _test(inside[0])
        return lambda value: isinstance(value, tuple) and all(map(each, value))
    tests = [_test(one) for one in inside]
    return lambda value: (
        isinstance(value, tuple)
        and len(value) == len(tests)
        and all(test(item) for test, item in zip(tests, value, strict=True))
    )
