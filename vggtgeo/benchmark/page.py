"""Write `report.html` of a suite: this file selects the content, `page.html.j2` has the layout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vggtgeo.benchmark import cells, figures, markdown
from vggtgeo.benchmark.published import published
from vggtgeo.benchmark.suite import Suite
from vggtgeo.benchmark.table import Row, run_name, select
from vggtgeo.benchmark.worker import LOG, RECORDING
from vggtgeo.io.files import write_text
from vggtgeo.report.figures import svg
from vggtgeo.report.viewer import style, template


def write_page(path: Path, suite: Suite, rows: Sequence[Row], folder: Path) -> None:
    """Write the page, atomically. folder: of the suite, whose runs are linked."""
    good = cells.finished(rows)
    there = [row for row in rows if row["status"] != "absent"]
    has_error = cells.summary_of(good, figures.headline(good)).count > 0
    versions = sorted({name for row in rows for name in row if name.startswith("version_")})
    names = ("version", "commit", "source", "machine", *versions)
    text = template("vggtgeo.benchmark", "page.html.j2").render(
        style=style(),
        title=suite.title,
        about=suite.about.strip().replace("`", ""),
        notice=markdown.notice(suite, rows).replace("`", ""),
        facts=_facts(suite, there),
        tables=[
            {"head": column.head, "columns": heads, "rows": lines}
            for column in (cells.SE3, cells.SIM3)
            for heads, lines in [cells.matrix(suite, there, column)]
            if any(cell.text for _, line in lines for cell in line)
        ],
        base=suite.title_of(suite.base),
        compared=[column.head for column in cells.COMPARED],
        differences=cells.differences(suite, good),
        ablations=svg(figures.ablation_figure(suite, good, 7.5)) if has_error else None,
        sequences=[
            {
                "name": name,
                "figure": svg(figures.paths_figure(drawn))
                if (drawn := figures.paths(suite, good, name, folder))
                else None,
                "tables": _details(suite, there, name),
            }
            for name in cells.sequences_of(suite, good)
        ],
        cost=svg(figures.cost_figure(suite, good, 7.5)) if any("frames" in row for row in good) else None,
        runs=[_run(suite, row, folder) for row in rows],
        broken=[row for row in rows if row["status"] not in ("ok", "absent")],
        absent=sorted({row["sequence"] for row in rows if row["status"] == "absent"}),
        published=[published(name) for name in suite.published],
        provenance=[(name.removeprefix("version "), text) for name, text in cells.provenance(rows, names)],
    )
    write_text(path, text)


def _facts(suite: Suite, rows: Sequence[Row]) -> list[tuple[str, str]]:
    good = cells.finished(rows)
    levels = [row.get("verdict") for row in good]
    seconds = sum(float(row.get("seconds_wall") or 0.0) for row in rows)
    return [
        (f"{len(good)} / {len(rows)}", "runs with a result"),
        (str(len(cells.sequences_of(suite, good))), "sequences"),
        (str(len(cells.settings_of(suite, good))), "settings"),
        *((str(levels.count(level)), f"called {level}") for level in ("good", "degraded", "failed") if level in levels),
        (f"{seconds / 60:.0f} min" if seconds >= 60 else f"{seconds:.0f} s", "of runs"),
    ]


def _details(suite: Suite, rows: Sequence[Row], sequence: str) -> list[dict[str, Any]]:
    """Return a table for each group of numbers; the one of the poses has the number of runs and the verdicts."""
    settings = cells.settings_of(suite, select(cells.finished(rows), sequence))
    groups = [select(rows, sequence, setting) for setting in settings]
    tables = []
    for title, columns in cells.GROUPS.items():
        shown = cells.measured(groups, columns)
        by_column = [cells.ranked(groups, column, beside_count=True) for column in shown]
        lines = [
            {
                "title": suite.title_of(setting),
                "runs": cells.runs_text(own),
                "tracked": cells.tracked(own),
                "cells": [line[row] for line in by_column],
                "verdict": cells.verdicts(own),
            }
            for row, (setting, own) in enumerate(zip(settings, groups, strict=True))
        ]
        if shown or title == "Poses":
            tables.append(
                {"title": cells.heading(title, groups), "heads": [column.head for column in shown], "lines": lines}
            )
    return tables


def _run(suite: Suite, row: Row, folder: Path) -> dict[str, Any]:
    place = Path("runs") / run_name(row)
    files = {"page": "report.html", "poses": "estimate.txt", "recording": RECORDING, "log": LOG}
    there = {name: (place / file).as_posix() for name, file in files.items() if (folder / place / file).is_file()}
    return {
        **{name: row.get(name) for name in ("sequence", "seed", "status", "verdict", "message", "warnings", "reasons")},
        "setting": suite.title_of(str(row["setting"])),
        "links": there,
    }
