"""Figures published by others, as data: each table with its source and protocol."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, Self

from vggtgeo.io.errors import InputError

LOST = "lost"


class Printed(float):
    """A number that is printed with the digits of its source: 0.050, not 0.05."""

    def __new__(cls, text: object) -> Self:
        made = super().__new__(cls, str(text))
        made.text = str(text)
        return made

    text: str

    def __str__(self) -> str:
        return self.text


Figure = float | str | None


@dataclass(frozen=True)
class PublishedTable:
    """A published table.

    Fields: title, source, protocol, as text; columns, their heads; rows, numbers by system, `LOST` if it lost track,
    None if not published; unit of the numbers; papers of the systems; uncalibrated, systems without known intrinsics.
    """

    name: str
    title: str
    source: str
    protocol: str
    unit: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[Figure, ...]]
    papers: Mapping[str, str]
    uncalibrated: tuple[str, ...] = ()

    @property
    def has_gaps(self) -> bool:
        """Whether some figures are not published."""
        return any(None in numbers for numbers in self.rows.values())

    def lines(self) -> list[list[str]]:
        """Return a row of texts per system: name (with a star if uncalibrated), numbers, paper."""
        return [
            [f"{name}{'*' * (name in self.uncalibrated)}", *map(figure_text, numbers), self.papers[name]]
            for name, numbers in self.rows.items()
        ]


def figure_text(figure: Figure) -> str:
    """Return a figure as text for a table."""
    return "-" if figure is None else str(figure)


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
    values = tomllib.loads((_folder() / f"{name}.toml").read_text("utf-8"), parse_float=Printed)
    columns = tuple(values.pop("columns"))
    rows = {
        system: tuple(None if number == "" else LOST if number == LOST else Printed(number) for number in numbers)
        for system, numbers in values.pop("rows").items()
    }
    papers = tomllib.loads((files("vggtgeo.benchmark") / "systems.toml").read_text("utf-8"))
    own = {system: papers[system] for system in rows}
    plain: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    return PublishedTable(name, columns=columns, rows=rows, papers=own, **plain)
