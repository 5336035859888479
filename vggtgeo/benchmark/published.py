"""Figures that other groups published, as data: each table with its source and its protocol."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from vggtgeo.io.errors import InputError


@dataclass(frozen=True)
class PublishedTable:
    """title, source, protocol: in words. columns: heads. rows: numbers by system, None where it has none or was lost.
    unit: of the numbers. uncalibrated: systems that were not given the intrinsics.
    """

    name: str
    title: str
    source: str
    protocol: str
    unit: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[float | None, ...]]
    uncalibrated: tuple[str, ...] = ()


def published(name: str) -> PublishedTable:
    """The table of a file in `vggtgeo/benchmark/published`; InputError where there is none of that name."""
    folder = files("vggtgeo.benchmark") / "published"
    there = sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml"))
    if name not in there:
        raise InputError(f"there is no published table `{name}`; there are {', '.join(there)}")
    values = tomllib.loads((folder / f"{name}.toml").read_text("utf-8"))
    columns = tuple(values.pop("columns"))
    rows = {
        system: tuple(None if number == "lost" or number == "" else float(number) for number in numbers)
        for system, numbers in values.pop("rows").items()
    }
    if any(len(numbers) != len(columns) for numbers in rows.values()):
        raise InputError(f"published table `{name}`: each row must have {len(columns)} numbers")
    return PublishedTable(name, columns=columns, rows=rows, **{key: _value(value) for key, value in values.items()})


def _value(value: object) -> Any:
    return tuple(value) if isinstance(value, list) else value
