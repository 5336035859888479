"""Settings as text: tables of a TOML file (`[keyframes]`), assignments (`keyframes.min_inliers=20`).

A kernel is its name and its numbers, in the order of its fields: `huber 1.5`, `cauchy 2.0`, `square`.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.slam.settings.groups import is_kernel
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.solvers.kernels import AbstractKernel, Barron, Cauchy, GemanMcClure, Huber, Square

KERNELS: dict[str, Callable[..., AbstractKernel]] = {
    kind.__name__.lower(): kind for kind in (Barron, Cauchy, GemanMcClure, Huber, Square)
}
GROUPS = tuple(entry.name for entry in dataclasses.fields(SlamSettings))
Tables = Mapping[str, Mapping[str, Any]]
"""Values by the names of group and field."""


def names() -> tuple[str, ...]:
    """Return every setting as `group.field`, in the order of the declaration."""
    defaults = SlamSettings()
    return tuple(f"{group}.{entry.name}" for group in GROUPS for entry in dataclasses.fields(getattr(defaults, group)))


def updated(settings: SlamSettings, tables: Tables) -> SlamSettings:
    """Return `settings` with the values of `tables`, all validated together.

    Raises:
        InputError: an unknown setting, or an invalid value.

    """
    groups: dict[str, Any] = {}
    for group, values in tables.items():
        if group not in GROUPS:
            raise InputError(f"groups of settings must be among {', '.join(GROUPS)}, got `{group}`")
        for field in values:
            _check_name(f"{group}.{field}")
        plain = {
            field: _kernel(f"{group}.{field}", value) if field == "kernel" and isinstance(value, str) else value
            for field, value in values.items()
        }
        groups[group] = dataclasses.replace(getattr(settings, group), **plain)
    return dataclasses.replace(settings, **groups)


def parsed(assignment: str) -> Tables:
    """Return `group.field=value` as a table; the value as in TOML, or a word without quotes.

    Raises:
        InputError: there is no `=`, or the setting is unknown.

    """
    name, equals, text = (part.strip() for part in assignment.partition("="))
    if not equals:
        raise InputError(f"`{assignment}` sets nothing; write `group.field=value`, such as `keyframes.min_inliers=20`")
    _check_name(name)
    group, field = name.split(".")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except ValueError:  # a word, or a number of more digits than Python reads
        value = text
    return {group: {field: value}}


def tables_of(settings: SlamSettings) -> dict[str, dict[str, Any]]:
    """Return every value in the form that `updated` takes, of types that TOML and JSON support."""
    found: dict[str, dict[str, Any]] = {group: {} for group in GROUPS}
    for name in names():
        group, field = name.split(".")
        found[group][field] = _plain(getattr(getattr(settings, group), field))
    return found


def changed(settings: SlamSettings) -> dict[str, dict[str, Any]]:
    """Return the values that are not the defaults, in the same form."""
    defaults = tables_of(SlamSettings())
    different = {
        group: {field: value for field, value in values.items() if value != defaults[group][field]}
        for group, values in tables_of(settings).items()
    }
    return {group: values for group, values in different.items() if values}


def _plain(value: Any) -> Any:
    if isinstance(value, AbstractKernel):
        numbers = (repr(float(getattr(value, entry.name))) for entry in dataclasses.fields(value))
        return " ".join((type(value).__name__.lower(), *numbers))
    return value.item() if isinstance(value, np.generic) else value


def _check_name(name: str) -> None:
    known = names()
    if name not in known:
        field = name.rpartition(".")[2]
        same = [other for other in known if other.endswith(f".{field}")]
        nearest = (same or difflib.get_close_matches(name, known, 1, 0.0))[0]
        raise InputError(f"`{name}` is no setting; the nearest is `{nearest}`")


def _kernel(name: str, text: str) -> AbstractKernel:
    kind, *numbers = text.split() or [""]
    kernel: AbstractKernel | None
    try:
        values = [float(number) for number in numbers]
        kernel = KERNELS[kind.lower()](*values) if all(map(math.isfinite, values)) else None
    except (KeyError, TypeError, ValueError):
        kernel = None
    if kernel is None or not is_kernel(kernel):
        expected = f"one of {', '.join(KERNELS)} and its numbers, the width above 0, such as `cauchy 2.0`"
        raise InputError(f"`{name}` must be {expected}, got {text!r}")
    return kernel
