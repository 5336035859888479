"""Puts the tables and the figure of a finished `vggtgeo bench paper` into docs/paper-tables.md.

.venv/bin/python docs/write_paper_tables.py [RUN_FOLDER]     (runs/paper if left out)
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from vggtgeo.io.files import atomic_path, write_text

DOCS = Path(__file__).resolve().parent
BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"


def with_tables(page: str, tables: str) -> str:
    """The page with `tables` between its two marks."""
    head, rest = page.split(BEGIN)
    return head + BEGIN + "\n" + tables.strip() + "\n" + END + rest.split(END)[1]


def main() -> None:
    """Rewrite the page from the folder named on the command line."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/paper")
    page = DOCS / "paper-tables.md"
    write_text(page, with_tables(page.read_text(), (folder / "tables.md").read_text()))
    with atomic_path(DOCS / "paper-tables.png") as temporary:
        shutil.copyfile(folder / "ablations.png", temporary)


if __name__ == "__main__":
    main()
