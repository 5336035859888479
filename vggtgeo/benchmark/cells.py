"""Table cells: numbers as text and their ranks, for Markdown and the HTML report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.benchmark.suite import Suite
from vggtgeo.benchmark.table import Row, Summary, number, paired, select, values


@dataclass(frozen=True)
class Column:
    """A column of a table. name: of the row's value; factor: to the unit of the head; better: -1 if less is better, 1
    if more is better, 0 if not ranked.
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


@dataclass(frozen=True)
class Cell:
    """A text, its rank (1 best, 2 second, 0 others), and the median beside the mean; empty for few numbers."""

    text: str
    place: int = 0
    median: str = ""


MIN_FOR_MEDIAN = 3
"""Numbers: the median of two is their mean."""


def median_text(summary: Summary, column: Column) -> str:
    """Return the median, which published tables often have instead of the mean; empty for few numbers or an unranked
    column.
    """
    return f"{summary.median:.{column.digits}f}" if column.better and summary.count >= MIN_FOR_MEDIAN else ""


FREE = "free"
"""Shown instead of an SE(3) error for runs of free scale."""


def comparable(rows: Sequence[Row], column: Column) -> list[Row]:
    """Return the rows whose value is meaningful: an SE(3) error of a free scale is not."""
    return [row for row in rows if column is not SE3 or row.get("metric") is not False]


def summary_of(rows: Sequence[Row], column: Column) -> Summary:
    """Return the summary of a column in its unit, over the runs with a result."""
    return Summary.of(column.factor * values(comparable(finished(rows), column), column.name))


def finished(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of runs with a result."""
    return [row for row in rows if row["status"] == "ok"]


MIN_COVERAGE = 0.9
"""Share of the ground truth's duration; with less, the error is of another, mostly easier, part of the sequence."""


def is_covered(rows: Sequence[Row]) -> bool:
    """Return whether no run is known to cover less than `MIN_COVERAGE`."""
    return not (values(rows, "coverage") < MIN_COVERAGE).any()


def is_ranked(rows: Sequence[Row], column: Column) -> bool:
    """Return whether the mean may be ranked: every run has a number, and none covers too little.

    Without failed runs, a mean favours settings that fail on hard ones.
    """
    is_whole = bool(rows) and summary_of(rows, column).count == len(rows)
    return is_whole and (column.name == "coverage" or is_covered(rows))


def at_coverage(rows: Sequence[Row]) -> str:
    """Return the mean coverage of runs as text, rounded down; empty if unknown."""
    mean = Summary.of(values(finished(rows), "coverage")).mean
    return f" at {np.floor(100 * mean + 1e-9):.0f} %" if np.isfinite(mean) else ""


def text_of(rows: Sequence[Row], column: Column) -> str:
    """Return mean and standard deviation (if there are several numbers) as text, with the number of runs if some have
    no value; empty if none has.
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


def measured(groups: Sequence[Sequence[Row]], columns: Iterable[Column]) -> list[Column]:
    """Return the columns for which some run has a number."""
    return [column for column in columns if any(summary_of(own, column).count for own in groups)]


def heading(title: str, groups: Iterable[Sequence[Row]]) -> str:
    """Return the title of a group of columns; for the map with the distance threshold of its scores."""
    known = [number(row, "threshold_m") for own in groups for row in own]
    within = ", ".join(f"{100 * one:g}" for one in sorted({one for one in known if np.isfinite(one)}))
    return f"{title}, scores within {within} cm" if within and title == "Map" else title


def cell_of(rows: Sequence[Row], column: Column) -> Cell:
    """Return the cell of the runs with a result, unranked."""
    good = finished(rows)
    return Cell(text_of(good, column), 0, median_text(summary_of(good, column), column))


def _text_or_ending(rows: Sequence[Row], column: Column) -> str:
    """Return the text of a cell; without any number, how the runs failed."""
    text = text_of(rows, column)
    lost = [row for row in rows if row["status"] != "ok" or row.get("verdict") == "failed"]
    return f"{text}{at_coverage(rows)}" if text and text != FREE else text or verdicts(lost)


def ranked(groups: Sequence[Sequence[Row]], column: Column, beside_count: bool = False) -> list[Cell]:
    """Return a cell for each group of rows; groups with missing numbers or too little coverage are not ranked.

    beside_count: whether the table has columns for the number of runs and the coverage, so that cells omit them.
    """
    means = [summary_of(own, column).mean if is_ranked(own, column) else np.nan for own in groups]
    texts = [text_of(finished(own), column) if beside_count else _text_or_ending(own, column) for own in groups]
    return placed(means, column, texts, [median_text(summary_of(own, column), column) for own in groups])


def runs_text(rows: Sequence[Row]) -> str:
    """Return the number of runs with a result, and of all runs if it differs."""
    good = len(finished(rows))
    return str(good) if good == len(rows) else f"{good} of {len(rows)}"


def placed(numbers: Sequence[float], column: Column, texts: Sequence[str], medians: Sequence[str]) -> list[Cell]:
    """Return cells with the best and the second best ranked, if there are two or more different numbers."""
    known = sorted({round(one, column.digits) for one in numbers if np.isfinite(one)}, reverse=column.better > 0)
    compared = column.better and len(known) >= 2
    place = lambda one: known.index(round(one, column.digits)) + 1 if compared and np.isfinite(one) else 0
    ranks = [rank if (rank := place(one)) <= 2 else 0 for one in numbers]
    return [Cell(*parts) for parts in zip(texts, ranks, medians, strict=True)]


def settings_of(suite: Suite, rows: Sequence[Row]) -> list[str]:
    """Return the settings and other systems with a row, in the order of the suite."""
    there = {row["setting"] for row in rows}
    return [table.name for table in (*suite.setting, *suite.external) if table.name in there]


def sequences_of(suite: Suite, rows: Sequence[Row]) -> list[str]:
    """Return the sequences with a row, in the order of the suite."""
    there = {row["sequence"] for row in rows}
    return [table.name for table in suite.sequence if table.name in there]


def matrix(suite: Suite, rows: Sequence[Row], column: Column) -> tuple[list[str], list[tuple[str, list[Cell]]]]:
    """Return the heads, and a row per setting: a cell per sequence, then mean (with the mean of the medians over seeds)
    and median over the sequences on which all settings that are ranked at all are ranked. rows: include those without a
    result.
    """
    settings, sequences = settings_of(suite, rows), sequences_of(suite, rows)
    groups = {name: [select(rows, name, setting) for setting in settings] for name in sequences}
    ranks = {name: [is_ranked(own, column) for own in groups[name]] for name in sequences}
    used = [any(ranks[name][row] for name in sequences) for row in range(len(settings))]
    common = [name for name in sequences if ranks[name] == used]
    heads, by_column = [*sequences], [ranked(groups[name], column) for name in sequences]
    if len(common) > 1:
        of = "" if len(common) == len(sequences) else f" of {len(common)}"
        lists = [[summary_of(groups[name][row], column) for name in common if has] for row, has in enumerate(used)]
        pooled = [Summary.of(np.array([one.mean for one in own])) for own in lists]
        text = lambda number: f"{number:.{column.digits}f}" if np.isfinite(number) else ""
        # Means of medians, as in publications, if each sequence has enough seeds.
        enough = [min((one.count for one in own), default=0) >= MIN_FOR_MEDIAN for own in lists]
        medians = [
            np.mean([one.median for one in own]) if many else np.nan for own, many in zip(lists, enough, strict=True)
        ]
        means = [one.mean for one in pooled]
        by_column.append(placed(means, column, list(map(text, means)), list(map(text, medians))))
        heads.append(f"mean{of}")
        if len(common) >= MIN_FOR_MEDIAN:
            heads.append(f"median{of}")
            numbers = [one.median for one in pooled]
            by_column.append(placed(numbers, column, list(map(text, numbers)), [""] * len(pooled)))
    lines = [(suite.title_of(setting), [cells[row] for cells in by_column]) for row, setting in enumerate(settings)]
    return heads, lines


@dataclass(frozen=True)
class Difference:
    """Paired differences of a setting to the baseline. sequence: its name, or "all". cells: one per column."""

    setting: str
    sequence: str
    pairs: int
    cells: tuple[Cell, ...]


COMPARED = (SE3, SIM3, RRE, DEPTH_RMSE, F_SCORE)


def differences(suite: Suite, rows: Sequence[Row]) -> list[Difference]:
    """Return setting minus baseline on the same sequence and seed; rank 1 (better) or 2 (worse) if the 95 % interval
    excludes zero. Over all sequences, a recording is one sample, a rendered world one per seed (each is a new walk).
    """
    found = []
    rendered = {one.name for one in suite.sequence if one.simulate}
    recorded = set(sequences_of(suite, rows)) - rendered
    for setting in settings_of(suite, rows):
        if setting == suite.base:
            continue
        names: list[str | None] = [*sequences_of(suite, rows)]
        for sequence in [*names, None] if len(names) > 1 else names:
            lists = [
                column.factor * paired(comparable(rows, column), setting, suite.base, column.name, sequence, recorded)
                for column in COMPARED
            ]
            pairs = max(len(one) for one in lists)
            if pairs:
                cells = tuple(_difference(Summary.of(one), column) for one, column in zip(lists, COMPARED, strict=True))
                found.append(Difference(suite.title_of(setting), sequence or "all", pairs, cells))
    return found


def _difference(summary: Summary, column: Column) -> Cell:
    """Return a mean difference with its 95 % interval, without interval for a single pair."""
    if not summary.count:
        return Cell("")
    interval = "(one pair)" if np.isnan(summary.half) else f"± {summary.half:.{column.digits}f}"
    place = (1 if summary.mean * column.better > 0 else 2) if summary.differs else 0
    return Cell(f"{summary.mean:+.{column.digits}f} {interval}", place)


def verdicts(rows: Sequence[Row]) -> str:
    """Return verdicts, or statuses of runs without a result, with counts if there are several."""
    words = [str((row["status"] == "ok" and row.get("verdict")) or row["status"]) for row in rows]
    counts = {word: words.count(word) for word in dict.fromkeys(words)}
    return ", ".join(word if len(words) == 1 else f"{count} {word}" for word, count in counts.items())


def tracked(rows: Sequence[Row]) -> str:
    """Return tracked and read frames of all runs together."""
    known = [row for row in rows if row.get("frames")]
    return f"{sum(row['tracked'] for row in known)}/{sum(row['frames'] for row in known)}" if known else ""


def provenance(rows: Sequence[Row], names: Iterable[str]) -> list[tuple[str, str]]:
    """Return a name and the different values of each column of `names` that has any."""
    found = {name: [str(value) for value in dict.fromkeys(row.get(name) for row in rows) if value] for name in names}
    return [(name.replace("_", " "), ", ".join(values)) for name, values in found.items() if values]
