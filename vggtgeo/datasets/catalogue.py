"""Recordings that the readers know, and where to get them: the table of `vggtgeo data list`."""

import tomllib
from dataclasses import dataclass
from importlib.resources import files


@dataclass(frozen=True)
class Entry:
    """name; kind, of the reader; suite of `vggtgeo bench`, "" for none; url; size, rough; licence; layout; note."""

    name: str
    kind: str
    suite: str
    url: str
    size: str
    licence: str
    layout: str
    note: str


def catalogue() -> tuple[Entry, ...]:
    """Return all entries."""
    text = (files("vggtgeo.datasets") / "catalogue.toml").read_text("utf-8")
    return tuple(Entry(**entry) for entry in tomllib.loads(text)["entry"])
