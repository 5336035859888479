"""Figures published by others, as data: each table with its source and protocol."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

from vggtgeo.io.errors import InputError


@dataclass(frozen=True)
class PublishedTable:
    """A published table.

    Fields: title, source, protocol, as text; columns, their heads; rows, numbers by system with the digits of the
    source, "lost" if it lost track, empty if not published; unit of the numbers; papers of the systems; uncalibrated,
    systems without known intrinsics.
    """

    name: str
    title: str
    source: str
    protocol: str
    unit: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[str, ...]]
    papers: Mapping[str, str]
    uncalibrated: tuple[str, ...] = ()

    @property
    def has_gaps(self) -> bool:
        """Whether some figures are not published."""
        return any("" in numbers for numbers in self.rows.values())

    def lines(self) -> list[list[str]]:
        """Return a row of texts per system: name (with a star if uncalibrated), numbers, paper."""
        return [
            [f"{name}{'*' * (name in self.uncalibrated)}", *(number or "-" for number in numbers), self.papers[name]]
            for name, numbers in self.rows.items()
        ]


def _folder() -> Traversable:
    return files("vggtgeo.benchmark") / "published"


def check_published(name: str) -> None:
    """Raise InputError for an unknown table."""
    known = sorted(entry.name[:-5] for entry in _folder().iterdir() if entry.name.endswith(".toml"))
    if name not in known:
        raise InputError(f"`published` must be of {', '.join(known)}, got `{name}`")


def published(name: str) -> PublishedTable:
    """Load a table from `vggtgeo/benchmark/published`; raise InputError for an unknown name."""
    check_published(name)
    values = tomllib.loads((_folder() / f"{name}.toml").read_text("utf-8"), parse_float=str)
    papers = tomllib.loads((files("vggtgeo.benchmark") / "systems.toml").read_text("utf-8"))
    values["rows"] = {system: tuple(map(str, numbers)) for system, numbers in values["rows"].items()}
    values["papers"] = {system: papers[system] for system in values["rows"]}
    plain: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    return PublishedTable(name, **plain)
