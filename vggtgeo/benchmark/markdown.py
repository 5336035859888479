"""Tables of a suite as Markdown: best in bold, second best underlined."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from vggtgeo.benchmark import cells
from vggtgeo.benchmark.cells import Cell
from vggtgeo.benchmark.published import PublishedTable, published
from vggtgeo.benchmark.suite import PROTOCOLS, Suite
from vggtgeo.benchmark.table import Row, select


def page(suite: Suite, rows: Sequence[Row]) -> str:
    """Return all tables."""
    good = cells.finished(rows)
    there = [row for row in rows if row["status"] != "absent"]
    parts = [f"# {' '.join(suite.title.split())}", *([suite.about.strip()] if suite.about else []), notice(suite, rows)]
    if good:
        parts += ["## Accuracy", f"ATE RMSE after SE(3) alignment, cm{_COVERED}", accuracy(suite, there, cells.SE3)]
        parts += [f"ATE RMSE after Sim(3) alignment, cm{_COVERED}", accuracy(suite, there, cells.SIM3)]
        if cells.differences(suite, good):
            parts += [f"## Against {suite.title_of(suite.base)}", _DIFFERENCES, differences(suite, good)]
        parts += ["## Each sequence and setting", *details(suite, there)]
    if any(row.get("warnings") for row in good):
        parts += ["## Warnings", doubts(good)]
    if len(good) < len(rows):
        parts += ["## Without a result", failures(rows)]
    for name in suite.published:
        parts += [published_table(published(name))]
    if any(row.get("version") for row in rows):
        parts += ["## Provenance", table(["", ""], cells.provenance(rows, _PROVENANCE))]
    return "\n\n".join(part for part in parts if part) + "\n"


_PROVENANCE = ("version", "commit", "source", "machine", "version_jax", "version_numpy", "version_python")
_COVERED = (
    f", at the share of the truth's duration that is covered: below {100 * cells.MIN_COVERAGE:.0f} % an error is not "
    "ranked."
)
_DIFFERENCES = (
    "On the same sequence and seed, over the time that both cover: mean difference and its 95 % interval (Student), "
    "negative is less. Bold where the interval leaves zero out."
)


def notice(suite: Suite, rows: Sequence[Row]) -> str:
    """Return a paragraph on the kind of numbers: simulated or recorded, seeds, protocol."""
    kinds = {bool(row.get("simulated")) for row in rows if row["status"] == "ok"}
    kind = {
        frozenset({True}): "Simulated: rendered worlds with exact truth. ",
        frozenset({True, False}): "Sequences that are simulated are called so in `runs.csv`. ",
    }.get(frozenset(kinds), "")
    roles = "Perception is simulated, too: stubs of the five roles with stated error models. "
    stubs = roles if any(row.get("perception") == "simulated" for row in rows) else ""
    seeds = f"Seeds from {suite.first_seed}; mean ± standard deviation over seeds"
    most = max((len(select(rows, row["sequence"], row["setting"])) for row in rows), default=0)
    seeds += " / median." if most >= cells.MIN_FOR_MEDIAN else "."
    names = dict.fromkeys(str(row["protocol"]) for row in rows)
    protocols = "; ".join(f"{name}: {PROTOCOLS[name].about}" for name in names)
    return f"{kind}{stubs}Suite `{suite.name}`, {_count(rows)}. {seeds} Protocol {protocols}."


def _count(rows: Sequence[Row]) -> str:
    """Number of runs, missing recordings and rows of other systems."""
    others = sum("external" in row for row in rows)
    absent = sum(row["status"] == "absent" for row in rows)
    runs = len(rows) - others - absent
    text = f"{runs} runs" if runs != 1 else "1 run"
    text += f", {absent} more without their recording" if absent else ""
    return text + (f", {others} of other systems" if others else "")


def accuracy(suite: Suite, rows: Sequence[Row], column: cells.Column) -> str:
    """Return a table with a row per setting and a column per sequence."""
    heads, lines = cells.matrix(suite, rows, column)
    return table(["setting", *heads], [[title, *map(_marked, line)] for title, line in lines])


def differences(suite: Suite, rows: Sequence[Row]) -> str:
    """Return the table of differences to the baseline."""
    heads = ["setting", "sequence", "pairs", *(column.head for column in cells.COMPARED)]
    lines = [
        [one.setting, one.sequence, str(one.pairs), *(f"**{c.text}**" if c.place else c.text for c in one.cells)]
        for one in cells.differences(suite, rows)
    ]
    return table(heads, lines)


def details(suite: Suite, rows: Sequence[Row]) -> list[str]:
    """Return a table for each group of numbers, with a row per sequence and setting."""
    runs = [
        ((sequence, suite.title_of(setting), cells.runs_text(own)), own)
        for sequence in cells.sequences_of(suite, rows)
        for setting in cells.settings_of(suite, rows)
        if cells.finished(own := select(rows, sequence, setting))
    ]
    groups = [own for _, own in runs]
    parts = []
    for title, columns in cells.GROUPS.items():
        poses = title == "Poses"
        shown = cells.measured(groups, (*columns, *_references(rows)) if poses else columns)
        lines = [
            [
                *names,
                *([cells.tracked(own)] if poses else []),
                *(_marked(cells.cell_of(own, column)) for column in shown),
                *([cells.verdicts(own)] if poses else []),
            ]
            for names, own in runs
            if poses or cells.measured([own], shown)
        ]
        heads = [column.head for column in shown]
        heads = ["tracked", *heads, "verdict"] if poses else heads
        if lines:
            parts += [f"### {cells.heading(title, groups)}", table(["sequence", "setting", "runs", *heads], lines)]
    return parts


def doubts(rows: Sequence[Row]) -> str:
    """Return the table of warnings about errors: few matched poses, an implausible scale."""
    names = ("sequence", "setting", "seed", "warnings")
    return table(names, [[str(row[name]) for name in names] for row in rows if row.get("warnings")])


def failures(rows: Sequence[Row]) -> str:
    """Return the table of runs without a result and their reasons; runs without data in one line."""
    absent = sorted({str(row["sequence"]) for row in rows if row["status"] == "absent"})
    names = ("sequence", "setting", "seed", "status", "message")
    lines = [[str(row.get(name, "")) for name in names] for row in rows if row["status"] not in ("ok", "absent")]
    parts = [table(names, lines)] if lines else []
    if absent:
        parts.append(f"Missing recordings: {', '.join(absent)} (`vggtgeo data list` shows where to get them).")
    return "\n\n".join(parts)


def published_table(given: PublishedTable) -> str:
    """Return a table of published figures, separate from the suite's own."""
    note = " `*`: not given the intrinsics." if given.uncalibrated else ""
    note += " `-`: not published." if given.has_gaps else ""
    return (
        f"## Published by others: {given.title}\n\nNot measured here; {given.unit}. Source: {given.source}. Protocol: "
        f"{given.protocol}.{note}\n\n{table(['system', *given.columns, 'paper'], given.lines())}"
    )


def table(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    row = lambda cells: "| " + " | ".join(text.replace("|", "\\|").replace("\n", " ") for text in cells) + " |"
    return "\n".join([row(heads), "|" + "---|" * len(heads), *map(row, lines)])


def _references(rows: Sequence[Row]) -> list[cells.Column]:
    """Return the columns of the errors against the other ground truths of the sequences."""
    names = dict.fromkeys(name for row in rows for name in row if re.fullmatch("ate_sim3_.+_m", name))
    return [cells.Column(f"{name[9:-2]} Sim(3) cm", name, 100.0) for name in names]


def _marked(cell: Cell) -> str:
    marks = {0: "{}", 1: "**{}**", 2: "<u>{}</u>"}
    text = marks[cell.place].format(cell.text) if cell.text else ""
    return f"{text} / {cell.median}" if text and cell.median else text
