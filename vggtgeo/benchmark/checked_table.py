"""Tables of a TOML file as dataclasses, with validation of keys and value types."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

from vggtgeo.io.errors import InputError


def _of(*kinds: type) -> Callable[[Any], bool]:
    """Exact type check: in Python, `isinstance(True, int)`."""
    return lambda value: type(value) in kinds


def _list_of(kind: type) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list | tuple) and all(type(one) is kind for one in value)


def _table_of(allowed: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, Mapping) and all(map(allowed, value.values()))


_ANY_TABLE = _table_of(lambda _: True)
_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "int": (_of(int), "a whole number"),
    "int | None": (_of(int, type(None)), "a whole number"),
    "float": (_of(int, float), "a number"),
    "float | None": (_of(int, float, type(None)), "a number"),
    "str": (_of(str), "a text"),
    "str | None": (_of(str, type(None)), "a text"),
    "bool": (_of(bool), "true or false"),
    "tuple[str, ...]": (_list_of(str), "a list of texts"),
    "tuple[int, ...]": (_list_of(int), "a list of whole numbers"),
    "Mapping[str, Any]": (_ANY_TABLE, "a table"),
    "Mapping[str, str]": (_table_of(_of(str)), "a table of texts"),
    "Tables": (_table_of(_ANY_TABLE), "a table of groups of settings, as `[setting.set.line]` makes one"),
}
"""Check and description of the allowed values, by the field's annotation."""


@dataclass(frozen=True, kw_only=True)
class CheckedTable:
    """A table of the file; its fields are the keys."""

    @classmethod
    def read(cls, where: str, values: Any) -> Self:
        """Return the table of plain values; raise InputError with `where` for an unknown key or an invalid value."""
        known = {entry.name: entry for entry in dataclasses.fields(cls)}
        if not isinstance(values, Mapping):
            raise InputError(f"{where} is {values!r}; it must be a table")
        for key in values:
            if key not in known:
                raise InputError(f"{where} has the key `{key}`; it may have {', '.join(known)}")
        missing = [f"`{name}`" for name, entry in known.items() if name not in values and _is_required(entry)]
        if missing:
            raise InputError(f"{where}: {', '.join(missing)} missing")
        for key, value in values.items():
            allowed, words = _KINDS.get(str(known[key].type), (lambda _: True, ""))
            if not allowed(value):
                raise InputError(f"{where}: `{key}` is {value!r}; it must be {words}")
        plain = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
        try:
            return cls(**plain)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None


def _is_required(entry: dataclasses.Field[Any]) -> bool:
    return entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING
