"""Compute the tables of a suite, for Markdown and for the HTML report."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from vggtgeo.benchmark.rows import Row, Summary, number, paired, select, values
from vggtgeo.benchmark.suite import PROTOCOLS, Suite, packaged


@dataclass(frozen=True)
class Column:
    """A column of a table. head: its title. name: key of the row's value. factor: converts to the unit in the title.
    better: -1 if less is better, 1 if more is better, 0 if not ranked.
    """

    head: str
    name: str
    factor: float = 1.0
    digits: int = 2
    better: int = -1


SE3 = Column("ATE SE(3) cm", "ate_se3_m", 100.0)
SIM3 = Column("ATE Sim(3) cm", "ate_sim3_m", 100.0)
RRE = Column("RRE deg/s", "rre_1s_deg")
DEPTH_RMSE = Column("depth RMSE cm", "depth_rmse_m", 100.0)
F_SCORE = Column("F-score %", "f_score", 100.0, 1, 1)
GROUPS: dict[str, tuple[Column, ...]] = {
    "Poses": (
        Column("covered %", "coverage", 100.0, 1, 1),
        SE3,
        SIM3,
        Column("scale", "scale", 1.0, 4, 0),
        Column("RTE cm/s", "rte_1s_m", 100.0),
        RRE,
        Column("RTE cm/m", "rte_1m_m", 100.0),
        Column("RRE deg/m", "rre_1m_deg"),
        Column("NEES place", "nees_place", 1.0, 2, 0),
        Column("NEES rotation", "nees_rotation", 1.0, 2, 0),
        Column("focal error %", "focal_error", 100.0, 2, 0),
    ),
    "Depth": (
        DEPTH_RMSE,
        Column("RMSE before adjustment cm", "depth_prior_rmse_m", 100.0),
        Column("AbsRel %", "depth_abs_rel", 100.0),
        Column("depth < 1.25 %", "depth_below_1_25", 100.0, 1, 1),
    ),
    "Map": (
        F_SCORE,
        Column("precision %", "precision", 100.0, 1, 1),
        Column("recall %", "recall", 100.0, 1, 1),
        Column("accuracy cm", "accuracy_m", 100.0),
        Column("completeness cm", "completeness_m", 100.0),
        Column("mesh F-score %", "mesh_f_score", 100.0, 1, 1),
        Column("mesh accuracy cm", "mesh_accuracy_m", 100.0),
        Column("mesh completeness cm", "mesh_completeness_m", 100.0),
    ),
    "Cost": (
        Column("frames/s", "frames_per_second", 1.0, 1, 0),
        Column("memory GB", "peak_memory_gb", 1.0, 2, 0),
    ),
}
"""Columns of each table of details; columns without any number are left out."""
COMPARED = (SE3, SIM3, RRE, DEPTH_RMSE, F_SCORE)
"""Columns of the differences to the baseline."""
MIN_FOR_MEDIAN = 3
"""Minimum number of runs for a median: that of two is their mean."""
MIN_COVERAGE = 0.9
"""Minimum share of the ground truth's duration: errors over less time are of a different, mostly easier, part."""
FREE = "free"
"""Shown instead of an SE(3) error for runs of unknown scale."""


@dataclass(frozen=True)
class Cell:
    """A number as text; its mark, "best", "second", "better", "worse" or ""; the median next to the mean, if any."""

    text: str
    mark: str = ""
    median: str = ""


@dataclass(frozen=True)
class Table:
    """A table. labels: titles of the first columns, which are texts; heads: of the others; lines: values by column."""

    title: str
    labels: tuple[str, ...]
    heads: tuple[str, ...]
    lines: Sequence[Sequence[str | Cell]]
    note: str = ""


def accuracy(suite: Suite, rows: Sequence[Row], column: Column) -> Table:
    """Return a table with a row per setting and a cell per sequence, then mean and median over sequences.

    The mean has beside it the mean of the medians over seeds. Both are over the sequences on which every setting is
    ranked, apart from settings that are ranked nowhere. rows: include those without a result.
    """
    settings, sequences = settings_of(suite, rows), sequences_of(suite, rows)
    groups = {name: [select(rows, name, setting) for setting in settings] for name in sequences}
    ranks = {name: [is_ranked(own, column) for own in groups[name]] for name in sequences}
    used = [any(ranks[name][row] for name in sequences) for row in range(len(settings))]
    common = [name for name in sequences if ranks[name] == used]
    heads, by_column = [*sequences], [_ranked(groups[name], column) for name in sequences]
    if len(common) > 1:
        of = "" if len(common) == len(sequences) else f" of {len(common)}"
        lists = [[summary_of(groups[name][row], column) for name in common if has] for row, has in enumerate(used)]
        pooled = [Summary.of(np.array([one.mean for one in own])) for own in lists]
        text = lambda number: f"{number:.{column.digits}f}" if np.isfinite(number) else ""
        # Publications have means of medians; these need enough seeds on each sequence.
        enough = [min((one.count for one in own), default=0) >= MIN_FOR_MEDIAN for own in lists]
        medians = [
            np.mean([one.median for one in own]) if many else np.nan for own, many in zip(lists, enough, strict=True)
        ]
        means = [one.mean for one in pooled]
        by_column.append(_marked_cells(means, column, list(map(text, means)), list(map(text, medians))))
        heads.append(f"mean{of}")
        if len(common) >= MIN_FOR_MEDIAN:
            heads.append(f"median{of}")
            numbers = [one.median for one in pooled]
            by_column.append(_marked_cells(numbers, column, list(map(text, numbers)), [""] * len(pooled)))
    lines: list[list[str | Cell]]
    lines = [[suite.title_of(setting), *(cells[row] for cells in by_column)] for row, setting in enumerate(settings)]
    note = (
        f"ATE RMSE after {'SE(3)' if column is SE3 else 'Sim(3)'} alignment, cm, with the covered share of the ground "
        f"truth's duration: errors below {100 * MIN_COVERAGE:.0f} % coverage are not ranked."
    )
    return Table(column.head, ("setting",), tuple(heads), lines, note)


def differences(suite: Suite, rows: Sequence[Row]) -> Table:
    """Return setting minus baseline on the same sequence and seed; marked if the 95 % interval excludes zero.

    In the row of all sequences a recording is one sample, a rendered world one sample per seed (each is a new walk).
    """
    rows = finished(rows)
    lines: list[list[str | Cell]] = []
    sequences = sequences_of(suite, rows)
    recorded = set(sequences) - {one.name for one in suite.sequence if one.simulate}
    for setting in settings_of(suite, rows):
        for sequence in [*sequences, None] if len(sequences) > 1 else sequences:
            lists = [
                column.factor * paired(comparable(rows, column), setting, suite.base, column.name, sequence, recorded)
                for column in COMPARED
            ]
            pairs = max(map(len, lists))
            if pairs and setting != suite.base:
                cells = [_difference(Summary.of(one), column) for one, column in zip(lists, COMPARED, strict=True)]
                lines.append([suite.title_of(setting), sequence or "all", str(pairs), *cells])
    note = (
        "Mean difference on the same sequence and seed, over the time that both cover, with its 95 % interval "
        "(Student). Differences are marked if the interval excludes zero."
    )
    labels, heads = ("setting", "sequence", "pairs"), tuple(column.head for column in COMPARED)
    return Table(f"Against {suite.title_of(suite.base)}", labels, heads, lines, note if lines else "")


def details(suite: Suite, rows: Sequence[Row]) -> list[Table]:
    """Return a table for each group of columns, with a row per sequence and setting."""
    runs = [
        (sequence, setting, own)
        for sequence in sequences_of(suite, rows)
        for setting in settings_of(suite, rows)
        if finished(own := select(rows, sequence, setting))
    ]
    tables = []
    for title, columns in GROUPS.items():
        poses, of_runs = title == "Poses", ("runs", "tracked") if title == "Poses" else ("runs",)
        known = (*columns, *_references(rows)) if poses else columns
        shown = [column for column in known if any(summary_of(own, column).count for *_, own in runs)]
        lines: list[list[str | Cell]] = [
            [
                *(sequence, suite.title_of(setting), _runs(own)),
                *([_tracked(own)] if poses else []),
                *(Cell(text_of(finished(own), column), "", _median(own, column)) for column in shown),
                *([verdicts(own)] if poses else []),
            ]
            for sequence, setting, own in runs
            if poses or any(summary_of(own, column).count for column in shown)
        ]
        heads = (*(column.head for column in shown), *(["verdict"] if poses else []))
        if lines:
            tables.append(Table(_heading(title, rows), ("sequence", "setting", *of_runs), heads, lines))
    return tables


def doubts(rows: Sequence[Row]) -> Table:
    """Return the table of warnings about errors: few matched poses, an implausible scale."""
    return _text_table(
        "Warnings", ("sequence", "setting", "seed", "warnings"), [row for row in rows if row.get("warnings")]
    )


def failures(rows: Sequence[Row]) -> Table:
    """Return the table of runs without a result and their reasons; its note lists missing recordings."""
    absent = sorted({str(row["sequence"]) for row in rows if row["status"] == "absent"})
    note = f"Missing recordings: {', '.join(absent)} (`vggtgeo data list` shows where to get them)." if absent else ""
    failed = [row for row in rows if row["status"] not in ("ok", "absent")]
    return _text_table("Without a result", ("sequence", "setting", "seed", "status", "message"), failed, note)


def published(name: str) -> Table:
    """Return a table of results published by others, digits as printed; `name` is a file in `published/`."""
    values = tomllib.loads(packaged("published")[name].read_text("utf-8"), parse_float=str)
    papers = tomllib.loads((files("vggtgeo.benchmark") / "systems.toml").read_text("utf-8"))
    known, starred = values["rows"], values.get("uncalibrated", ())
    note = f"Not measured here; {values['unit']}. Source: {values['source']}. Protocol: {values['protocol']}."
    note += " `*`: intrinsics unknown to the system." if starred else ""
    note += " `-`: not published." if any("" in numbers for numbers in known.values()) else ""
    lines = [
        [f"{system}{'*' * (system in starred)}", *(Cell(str(one) or "-") for one in numbers), papers[system]]
        for system, numbers in known.items()
    ]
    heads = (*values["columns"], "paper")
    return Table(f"Published by others: {values['title']}", ("system",), heads, lines, note)


def provenance(rows: Sequence[Row]) -> Table:
    """Return all different values of each column on code and machine."""
    versions = sorted({name for row in rows for name in row if name.startswith("version_")})
    lines = [
        [name.removeprefix("version_"), ", ".join(found)]
        for name in ("version", "commit", "source", "machine", *versions)
        if (found := [str(value) for value in dict.fromkeys(row.get(name) for row in rows) if value])
    ]
    return Table("Provenance", ("", ""), (), lines)


def notice(suite: Suite, rows: Sequence[Row]) -> str:
    """Return a paragraph that describes the runs: simulated or recorded, seeds, protocol."""
    kinds = {bool(row.get("simulated")) for row in rows if row["status"] == "ok"}
    kind = {
        frozenset({True}): "Simulated: rendered worlds with exact ground truth. ",
        frozenset({True, False}): "`runs.csv` marks simulated sequences. ",
    }.get(frozenset(kinds), "")
    roles = "Perception is simulated, too: stubs of the five roles with known error models. "
    stubs = roles if any(row.get("perception") == "simulated" for row in rows) else ""
    seeds = f"Seeds from {suite.first_seed}; mean ± standard deviation over seeds"
    most = max((len(select(rows, row["sequence"], row["setting"])) for row in rows), default=0)
    seeds += " / median." if most >= MIN_FOR_MEDIAN else "."
    names = dict.fromkeys(str(row["protocol"]) for row in rows)
    protocols = "; ".join(f"{name}: {PROTOCOLS[name].about}" for name in names)
    others, absent = sum("external" in row for row in rows), sum(row["status"] == "absent" for row in rows)
    runs = len(rows) - others - absent
    count = f"{runs} runs" if runs != 1 else "1 run"
    count += f", {absent} more without a recording" if absent else ""
    count += f", {others} of other systems" if others else ""
    return f"{kind}{stubs}Suite `{suite.name}`, {count}. {seeds} Protocol {protocols}."


def finished(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of runs with a result."""
    return [row for row in rows if row["status"] == "ok"]


def comparable(rows: Sequence[Row], column: Column) -> list[Row]:
    """Return the rows whose value is meaningful: an SE(3) error of an unknown scale is not."""
    return [row for row in rows if column is not SE3 or row.get("metric") is not False]


def summary_of(rows: Sequence[Row], column: Column) -> Summary:
    """Return the summary of a column in its unit, over the runs with a result."""
    return Summary.of(column.factor * values(comparable(finished(rows), column), column.name))


def is_covered(rows: Sequence[Row]) -> bool:
    """Return whether all runs cover at least `MIN_COVERAGE`, or have no known coverage."""
    return not (values(rows, "coverage") < MIN_COVERAGE).any()


def is_ranked(rows: Sequence[Row], column: Column) -> bool:
    """Return whether the mean may be ranked: every run has a number and sufficient coverage.

    A mean without the failed runs would favour settings that fail on hard sequences.
    """
    is_whole = bool(rows) and summary_of(rows, column).count == len(rows)
    return is_whole and (column.name == "coverage" or is_covered(rows))


def at_coverage(rows: Sequence[Row]) -> str:
    """Return the mean coverage of runs as text, rounded down; empty if unknown."""
    mean = Summary.of(values(finished(rows), "coverage")).mean
    return f" at {np.floor(100 * mean + 1e-9):.0f} %" if np.isfinite(mean) else ""


def text_of(rows: Sequence[Row], column: Column) -> str:
    """Return mean and standard deviation as text, with the number of runs if some have no value.

    A single number has no deviation; without numbers the text is empty.
    """
    good = finished(rows)
    if good and not comparable(good, column):
        return FREE
    summary = summary_of(rows, column)
    if not summary.count:
        return ""
    text = f"{summary.mean:.{column.digits}f}"
    text += "" if np.isnan(summary.deviation) else f" ± {summary.deviation:.{column.digits}f}"
    return text if summary.count == len(rows) else f"{text} ({summary.count} of {len(rows)})"


def settings_of(suite: Suite, rows: Sequence[Row]) -> list[str]:
    """Return the settings and other systems with a row, in the order of the suite."""
    there = {row["setting"] for row in rows}
    return [table.name for table in (*suite.setting, *suite.external) if table.name in there]


def sequences_of(suite: Suite, rows: Sequence[Row]) -> list[str]:
    """Return the sequences with a row, in the order of the suite."""
    there = {row["sequence"] for row in rows}
    return [table.name for table in suite.sequence if table.name in there]


def verdicts(rows: Sequence[Row]) -> str:
    """Return verdicts, or statuses of runs without a result, with counts if there are several."""
    words = [str((row["status"] == "ok" and row.get("verdict")) or row["status"]) for row in rows]
    counts = {word: words.count(word) for word in dict.fromkeys(words)}
    return ", ".join(word if len(words) == 1 else f"{count} {word}" for word, count in counts.items())


def _ranked(groups: Sequence[Sequence[Row]], column: Column) -> list[Cell]:
    """Return a cell for each group of rows; groups with missing numbers or too little coverage are not ranked."""
    means = [summary_of(own, column).mean if is_ranked(own, column) else np.nan for own in groups]
    return _marked_cells(
        means, column, [_text(own, column) for own in groups], [_median(own, column) for own in groups]
    )


def _text(rows: Sequence[Row], column: Column) -> str:
    """Return the text of a cell with its coverage; without a number, how the runs failed."""
    text = text_of(rows, column)
    lost = [row for row in rows if row["status"] != "ok" or row.get("verdict") == "failed"]
    return f"{text}{at_coverage(rows)}" if text and text != FREE else text or verdicts(lost)


def _median(rows: Sequence[Row], column: Column) -> str:
    """Return the median as text: published tables often have it instead of the mean."""
    summary = summary_of(rows, column)
    return f"{summary.median:.{column.digits}f}" if column.better and summary.count >= MIN_FOR_MEDIAN else ""


def _marked_cells(numbers: Sequence[float], column: Column, texts: Sequence[str], medians: Sequence[str]) -> list[Cell]:
    """Return cells with the best and the second best marked; no mark if all numbers are equal."""
    rounded = [round(one, column.digits) for one in numbers]
    known = sorted({one for one in rounded if np.isfinite(one)}, reverse=column.better > 0)
    marks = dict(zip(known, ("best", "second"), strict=False)) if column.better and len(known) > 1 else {}
    return [Cell(text, marks.get(one, ""), median) for one, text, median in zip(rounded, texts, medians, strict=True)]


def _difference(summary: Summary, column: Column) -> Cell:
    """Return a mean difference with its 95 % interval, without interval for a single pair."""
    if not summary.count:
        return Cell("")
    interval = "(one pair)" if np.isnan(summary.half) else f"± {summary.half:.{column.digits}f}"
    mark = ("better" if summary.mean * column.better > 0 else "worse") if summary.differs else ""
    return Cell(f"{summary.mean:+.{column.digits}f} {interval}", mark)


def _references(rows: Sequence[Row]) -> list[Column]:
    """Return the columns of the errors against the other ground truths of the sequences."""
    names = dict.fromkeys(name for row in rows for name in row if re.fullmatch("ate_sim3_.+_m", name))
    return [Column(f"{name[9:-2]} Sim(3) cm", name, 100.0) for name in names]


def _heading(title: str, rows: Sequence[Row]) -> str:
    """Return the title of a group of columns; for the map with the distance threshold of its scores."""
    known = {one for one in (number(row, "threshold_m") for row in rows) if np.isfinite(one)}
    within = ", ".join(f"{100 * one:g}" for one in sorted(known))
    return f"{title}, scores within {within} cm" if within and title == "Map" else title


def _runs(rows: Sequence[Row]) -> str:
    """Return the number of runs with a result, and of all runs if it differs."""
    good = len(finished(rows))
    return str(good) if good == len(rows) else f"{good} of {len(rows)}"


def _tracked(rows: Sequence[Row]) -> str:
    """Return the numbers of tracked and of read frames over all runs."""
    known = [row for row in rows if row.get("frames")]
    return f"{sum(row['tracked'] for row in known)}/{sum(row['frames'] for row in known)}" if known else ""


def _text_table(title: str, names: tuple[str, ...], rows: Sequence[Row], note: str = "") -> Table:
    return Table(title, names, (), [[str(row.get(name, "")) for name in names] for row in rows], note)
