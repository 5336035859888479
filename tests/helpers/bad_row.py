"""One row of the table of bad inputs; `bad_input_rows.py` has them all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bad_files as bad

from vggtgeo.datasets import open_sequence

Make = Callable[[Path], Any]


@dataclass(frozen=True)
class Row:
    """group and given: what the user gives. make: makes it in a folder. argv: the command line of what was made, or
    call: what the command line calls with it. slack: factor on the second, for what compiles or imports something.
    """

    group: str
    given: str
    make: Make
    argv: Callable[[Any], Sequence[Any]] | None = None
    call: Callable[[Any], Any] = lambda made: None
    slack: float = 1.0


def read_frames(folder: Any) -> None:
    """All frames and the truth, as a run reads them."""
    sequence = open_sequence(folder)
    for _ in sequence.frames():
        pass
    sequence.ground_truth()


def run_with(*flags: Any) -> Callable[[Path], Sequence[Any]]:
    """`vggtgeo run` on what was made, with flags."""
    return lambda made: ["run", made, "-o", made.parent / "out", *flags]


def solve_with(*flags: Any) -> Callable[[Path], Sequence[Any]]:
    """`vggtgeo solve` of what was made, with flags."""
    return lambda made: ["solve", made, "-o", made.parent / "solution.npz", *flags]


def line(*words: Any) -> Callable[[Any], Sequence[Any]]:
    """A command line without a file."""
    return lambda made: words


def nothing(folder: Path) -> Path:
    """The folder itself."""
    return folder


def good(folder: Path) -> Path:
    """Good images."""
    return bad.frames(folder / "frames")


def rows(group: str, entries: Sequence[tuple[Any, ...]], **common: Any) -> list[Row]:
    """Rows of a group: given, make, and what is not common."""
    return [
        Row(**{"group": group, "given": given, "make": make, **common, **dict(*more)}) for given, make, *more in entries
    ]
