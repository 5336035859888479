"""Validated fields: each setting states its bounds where it is declared, and is validated when it is made."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vggtgeo.io.errors import InputError


class Expected(NamedTuple):
    """Valid values of a setting: in words, for the error, and as a test."""

    words: str
    holds: Callable[[Any], bool]


def switch(default: bool) -> Any:
    """Declare a boolean setting."""
    return _field(default, Expected("true or false", lambda value: isinstance(value, bool)))


def whole(default: int, at_least: int, at_most: int = 1_000_000) -> Any:
    """Declare an integer setting. at_most: arrays have such sizes, and JAX counts in 32 bits."""
    holds = lambda value: _is_whole(value) and at_least <= value <= at_most
    return _field(default, Expected(f"a whole number from {at_least} to {at_most}", holds))


def positive(default: float, at_most: float = math.inf) -> Any:
    """Declare a setting that is a finite number above 0."""
    words = "a number above 0" if math.isinf(at_most) else f"a number above 0 and at most {at_most:g}"
    return _field(default, Expected(words, lambda value: _is_finite(value) and 0 < value <= at_most))


def not_negative(default: float, at_most: float = math.inf) -> Any:
    """Declare a setting that is a finite number of 0 or more."""
    words = "a number, 0 or more" if math.isinf(at_most) else f"a number from 0 to {at_most:g}"
    return _field(default, Expected(words, lambda value: _is_finite(value) and 0 <= value <= at_most))


def one_of(default: str, *others: str) -> Any:
    """Declare a setting that is one of some words."""
    words = (default, *others)
    return _field(default, Expected(" or ".join((", ".join(words[:-1]), words[-1])), lambda value: value in words))


@dataclasses.dataclass(frozen=True)
class CheckedSettings:
    """A group of settings, with fields of the functions above; `group` is its name in files and messages.

    Raises:
        InputError: a value is invalid; names the field, the value, and the valid values.

    """

    group: ClassVar[str]

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(self):
            expected, value = entry.metadata["expected"], getattr(self, entry.name)
            if not expected.holds(value):
                raise InputError(f"`{self.group}.{entry.name}` is {value!r:.60}; it must be {expected.words}")


def _field(default: Any, expected: Expected) -> Any:
    return dataclasses.field(default=default, metadata={"expected": expected})


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_finite(value: Any) -> bool:
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return is_number and -sys.float_info.max <= value <= sys.float_info.max  # whole numbers may be beyond all floats
