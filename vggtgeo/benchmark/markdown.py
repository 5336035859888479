"""The tables of a suite as Markdown: best in bold, second best underlined."""

from __future__ import annotations

from collections.abc import Sequence

from vggtgeo.benchmark import tables
from vggtgeo.benchmark.rows import Row
from vggtgeo.benchmark.suite import Suite
from vggtgeo.benchmark.tables import Cell, Table

_MARKS = {"": "{}", "second": "<u>{}</u>"}
"""Formats of cells by their mark; others are bold."""


def page(suite: Suite, rows: Sequence[Row]) -> str:
    """Return all tables."""
    good = tables.finished(rows)
    there = [row for row in rows if row["status"] != "absent"]
    parts = [f"# {' '.join(suite.title.split())}", suite.about.strip(), tables.notice(suite, rows)]
    if good:
        parts.append("## Accuracy")
        for column in (tables.SE3, tables.SIM3):
            found = tables.accuracy(suite, there, column)
            parts += [found.note, grid(found)]
        parts += [section(tables.differences(suite, good)), "## Each sequence and setting"]
        parts += [section(found, 3) for found in tables.details(suite, there)]
    parts += [section(found) for found in (tables.doubts(good), tables.failures(rows))]
    parts += [section(found) for found in (*map(tables.published, suite.published), tables.provenance(rows))]
    return "\n\n".join(part for part in parts if part) + "\n"


def section(table: Table, level: int = 2) -> str:
    """Return a table with its title and note; empty if it has neither lines nor note."""
    parts = [part for part in (table.note, grid(table) if table.lines else "") if part]
    return "\n\n".join([f"{'#' * level} {table.title}", *parts]) if parts else ""


def grid(table: Table) -> str:
    """Return a table without its title and note."""
    heads = (*table.labels, *table.heads)
    row = lambda cells: "| " + " | ".join(_text(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
    return "\n".join([row(heads), "|" + "---|" * len(heads), *map(row, table.lines)])


def _text(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return cell
    text = _MARKS.get(cell.mark, "**{}**").format(cell.text) if cell.text else ""
    return f"{text} / {cell.median}" if text and cell.median else text
