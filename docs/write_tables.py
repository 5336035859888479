"""Puts the tables of finished suites into the documents, between their marks.

.venv/bin/python docs/write_tables.py [RUN_FOLDER]     (`paper`, into docs/results/paper.md; runs/paper)
.venv/bin/python docs/write_tables.py --clips [RUN_FOLDER]     (`clips`, into docs/results/clips.md; runs/clips)
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

from vggtgeo.benchmark import figures, report, tables
from vggtgeo.benchmark.suite import load_suite
from vggtgeo.io.files import atomic_path, write_text

DOCS = Path(__file__).resolve().parent
BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"


def with_tables(page: str, tables: str) -> str:
    """The page with `tables` between its two marks."""
    head, rest = page.split(BEGIN)
    return head + BEGIN + "\n" + tables.strip() + "\n" + END + rest.split(END)[1]


def accuracy(tables: str) -> str:
    """The table of the ATE after SE(3) of `tables.md`, with its caption."""
    caption = "ATE RMSE after SE(3)"
    return caption + tables.partition(caption)[2].partition("ATE RMSE after Sim(3)")[0]


def load_rows(file: Path) -> list[dict[str, Any]]:
    """The rows of `runs.csv`, numbers as numbers."""
    with file.open(encoding="utf-8") as stream:
        return [{name: _value(text) for name, text in row.items() if text} for row in csv.DictReader(stream)]


def main() -> None:
    """Rewrite the document from the folder named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--clips", action="store_true", help="the table of docs/results/clips.md")
    arguments = parser.parse_args()
    name = "clips" if arguments.clips else "paper"
    folder = arguments.folder or Path("runs") / name
    suite, rows = load_suite(name), load_rows(folder / "runs.csv")
    if arguments.clips:
        good = [row for row in rows if row["status"] == "ok"]
        text = "\n\n".join(report.section(table, 3) for table in tables.details(suite, good))
        page = DOCS / "results" / "clips.md"
    else:
        page, text = DOCS / "results" / "paper.md", accuracy((folder / "tables.md").read_text())
        with atomic_path(DOCS / "paper-tables.png") as temporary:
            figures.ablation_figure(suite, rows).savefig(temporary, dpi=130, format="png", facecolor="white")
    write_text(page, with_tables(page.read_text(), text))


def _value(text: str) -> Any:
    if text in ("True", "False"):
        return text == "True"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


if __name__ == "__main__":
    main()
