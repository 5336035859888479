"""Fields that know what they may be: each setting states its bounds where it is declared, and is checked when made."""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from vggtgeo.io.errors import InputError


class Expected(NamedTuple):
    """What a setting may be: in words, for the error, and as a test."""

    words: str
    holds: Callable[[Any], bool]


def switch(default: bool) -> Any:
    """A setting that is true or false."""
    return _field(default, Expected("true or false", lambda value: isinstance(value, bool)))


def whole(default: int, at_least: int) -> Any:
    """A setting that is a whole number."""
    holds = lambda value: _is_whole(value) and value >= at_least
    return _field(default, Expected(f"a whole number, {at_least} or more", holds))


def positive(default: float, at_most: float = math.inf) -> Any:
    """A setting that is a finite number above 0."""
    words = "a number above 0" if math.isinf(at_most) else f"a number above 0 and at most {at_most:g}"
    return _field(default, Expected(words, lambda value: _is_finite(value) and 0 < value <= at_most))


def not_negative(default: float, at_most: float = math.inf) -> Any:
    """A setting that is a finite number of 0 or more."""
    words = "a number, 0 or more" if math.isinf(at_most) else f"a number from 0 to {at_most:g}"
    return _field(default, Expected(words, lambda value: _is_finite(value) and 0 <= value <= at_most))


def one_of(default: str, *others: str) -> Any:
    """A setting that is one of some words."""
    words = (default, *others)
    return _field(default, Expected(" or ".join((", ".join(words[:-1]), words[-1])), lambda value: value in words))


@dataclasses.dataclass(frozen=True)
class CheckedSettings:
    """A group of settings, its fields made by the functions above; `group` is its name in files and messages.

    Raises:
        InputError: a value is not what it may be; names the field, the value, and what is possible.

    """

    group: ClassVar[str]

    def __post_init__(self) -> None:
        for entry in dataclasses.fields(self):
            expected, value = entry.metadata["expected"], getattr(self, entry.name)
            if not expected.holds(value):
                raise InputError(f"`{self.group}.{entry.name}` is {value!r}; it must be {expected.words}")


def _field(default: Any, expected: Expected) -> Any:
    return dataclasses.field(default=default, metadata={"expected": expected})


def _is_whole(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def _is_finite(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
