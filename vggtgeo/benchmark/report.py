"""Write the report of a suite, as Markdown and as HTML, whose layout is in `page.html.j2`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vggtgeo.benchmark import figures, tables
from vggtgeo.benchmark.rows import Row, run_name
from vggtgeo.benchmark.suite import Suite
from vggtgeo.benchmark.tables import Cell, Table
from vggtgeo.benchmark.worker import LOG, RECORDING
from vggtgeo.io.files import write_text
from vggtgeo.report.figures import svg
from vggtgeo.report.viewer import style, template

_MARKS = {"": "{}", "second": "<u>{}</u>"}
"""Formats of cells by their mark; others are bold."""


def markdown(suite: Suite, rows: Sequence[Row]) -> str:
    """Return all tables as Markdown: the best in bold, the second best underlined."""
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


def write_page(path: Path, suite: Suite, rows: Sequence[Row], folder: Path) -> None:
    """Write the HTML page, atomically. folder: of the suite; the page links to its runs."""
    good = tables.finished(rows)
    there = [row for row in rows if row["status"] != "absent"]
    has_error = tables.summary_of(good, figures.headline(good)).count > 0
    drawn = {name: figures.paths(suite, good, name, folder) for name in tables.sequences_of(suite, good)}
    text = template("vggtgeo.benchmark", "page.html.j2").render(
        style=style(),
        title=suite.title,
        about=suite.about.strip().replace("`", ""),
        notice=tables.notice(suite, rows).replace("`", ""),
        facts=_facts(suite, there),
        failures=tables.failures(rows),
        accuracy=[tables.accuracy(suite, there, column) for column in (tables.SE3, tables.SIM3)] if good else [],
        ablations=svg(figures.ablation_figure(suite, good, 7.5)) if has_error else None,
        differences=tables.differences(suite, good),
        details=tables.details(suite, there),
        paths={name: svg(figures.paths_figure(found)) for name, found in drawn.items() if found},
        cost=svg(figures.cost_figure(suite, good, 7.5)) if any("frames" in row for row in good) else None,
        runs=[_run(suite, row, folder) for row in rows],
        others=[*map(tables.published, suite.published), tables.provenance(rows)],
    )
    write_text(path, text)


def _facts(suite: Suite, rows: Sequence[Row]) -> list[tuple[str, str]]:
    good = tables.finished(rows)
    levels = [row.get("verdict") for row in good]
    seconds = sum(float(row.get("seconds_wall") or 0.0) for row in rows)
    return [
        (f"{len(good)} / {len(rows)}", "runs with a result"),
        (str(len(tables.sequences_of(suite, good))), "sequences"),
        (str(len(tables.settings_of(suite, good))), "settings"),
        *(
            (str(levels.count(level)), f"with the verdict {level}")
            for level in ("good", "degraded", "failed")
            if level in levels
        ),
        (f"{seconds / 60:.0f} min" if seconds >= 60 else f"{seconds:.0f} s", "of runs"),
    ]


def _run(suite: Suite, row: Row, folder: Path) -> dict[str, Any]:
    place = Path("runs") / run_name(row)
    files = {"page": "report.html", "poses": "estimate.txt", "recording": RECORDING, "log": LOG}
    there = {name: (place / file).as_posix() for name, file in files.items() if (folder / place / file).is_file()}
    return {
        **{name: row.get(name) for name in ("sequence", "seed", "status", "verdict", "message", "warnings", "reasons")},
        "setting": suite.title_of(str(row["setting"])),
        "links": there,
    }
