"""Write the rows of runs as CSV and Parquet; compute means and paired differences with Student intervals."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from vggtgeo.io.errors import InputError, install_hint
from vggtgeo.io.files import atomic_path

Row = Mapping[str, Any]
"""A row of the table: plain values by column."""

FIRST = (
    *("suite", "sequence", "setting", "seed", "status", "message", "simulated", "protocol", "verdict"),
    *("frames", "tracked", "coverage", "keyframes", "matched", "metric", "path_m"),
    *("ate_se3_m", "ate_sim3_m", "scale", "ate_yaw_m", "ate_unaligned_m", "rte_1s_m", "rre_1s_deg"),
    *("rte_1m_m", "rre_1m_deg", "depth_rmse_m", "depth_abs_rel", "depth_below_1_25"),
    *("f_score", "precision", "recall", "mean_distance_m", "accuracy_m", "completeness_m", "threshold_m"),
    *("mesh_f_score", "mesh_accuracy_m", "mesh_completeness_m", "nees_place", "nees_rotation", "focal_error"),
    *("frames_per_second", "seconds_wall", "peak_memory_gb"),
)
"""Order of the first columns; the others follow, sorted by name."""


def run_name(row: Row) -> str:
    """Return the name of the run's folder."""
    return f"{row['sequence']}.{row['setting']}.{row['seed']}"


def columns(rows: Iterable[Row]) -> list[str]:
    """Return the columns of a table, in order."""
    there = {name for row in rows for name in row}
    return [name for name in FIRST if name in there] + sorted(there - set(FIRST))


def as_csv(rows: Sequence[Row]) -> str:
    """Return the table as CSV; missing values are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if value is None else value for name, value in row.items()} for row in rows)
    return text.getvalue()


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write the table as Parquet; raise InputError if PyArrow is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError(f"a Parquet table needs PyArrow; {install_hint('bench')}") from None
    values = {name: [row.get(name) for row in rows] for name in columns(rows)}
    table = pyarrow.table({name: pyarrow.array(_same_type(column)) for name, column in values.items()})
    with atomic_path(path) as temporary, temporary.open("wb") as stream:  # PyArrow accepts UTF-8 paths only
        pyarrow.parquet.write_table(table, stream)


def number(row: Row, column: str) -> float:
    """Return a value as a number; NaN if missing."""
    value = row.get(column)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else math.nan


def _same_type(column: list[Any]) -> list[Any]:
    """Convert the values to one type: to float if any is a float, else to text if types differ."""
    if any(isinstance(value, float) for value in column):
        return [float(value) if isinstance(value, int | float) else None for value in column]
    kinds = {type(value) for value in column if value is not None}
    return column if len(kinds) < 2 else [None if value is None else str(value) for value in column]


LEVEL = 0.95
"""Confidence level of the intervals."""
LESS_BASELINE = "_less_baseline"
"""Suffix of a column: the difference to the baseline over the common time."""
SAME = 1e-6
"""Relative spread below which numbers count as equal: the seed has no effect on such runs."""


@dataclass(frozen=True)
class Summary:
    """Count, mean, sample standard deviation, half width of the mean's 95 % Student interval, median of numbers.

    Deviation and half width of a single number are NaN.
    """

    count: int
    mean: float
    deviation: float
    half: float
    median: float

    @classmethod
    def of(cls, values: Float[np.ndarray, " n"]) -> Self:
        """Return the summary of the finite `values`."""
        known = values[np.isfinite(values)]
        count = len(known)
        if not count:
            return cls(0, np.nan, np.nan, np.nan, np.nan)
        deviation = float(np.std(known, ddof=1)) if count > 1 else np.nan
        half = float(stdtrit(count - 1, 0.5 + LEVEL / 2)) * deviation / np.sqrt(count) if count > 1 else np.nan
        return cls(count, float(known.mean()), deviation, float(half), float(np.median(known)))

    @property
    def differs(self) -> bool:
        """Whether the interval excludes zero. False for equal numbers: seeds without effect give no variance."""
        return bool(abs(self.mean) > self.half > SAME * abs(self.mean))


def select(rows: Sequence[Row], sequence: str | None = None, setting: str | None = None) -> list[Row]:
    """Return the rows of a sequence and a setting, sorted by sequence and seed."""
    chosen = [
        row
        for row in rows
        if (sequence is None or row["sequence"] == sequence) and (setting is None or row["setting"] == setting)
    ]
    return sorted(chosen, key=lambda row: (str(row["sequence"]), int(row["seed"])))


def values(rows: Sequence[Row], column: str) -> Float[np.ndarray, " n"]:
    """Return a column as numbers, NaN where missing."""
    return np.array([number(row, column) for row in rows], float)


def paired(
    rows: Sequence[Row],
    setting: str,
    baseline: str,
    column: str,
    sequence: str | None = None,
    recorded: Collection[str] = (),
) -> Float[np.ndarray, " n"]:
    """Return setting minus baseline on the same sequence and seed; over the common time if the row has that difference.

    recorded: sequences that do not depend on the seed. In a mean over sequences each of them is one sample, the mean
    over its seeds: ten seeds of two recordings are not twenty independent recordings.
    """
    other = {(row["sequence"], row["seed"]): number(row, column) for row in select(rows, sequence, baseline)}
    samples: dict[tuple[str, int | None], list[float]] = {}
    for row in select(rows, sequence, setting):
        difference = number(row, column) - other.get((row["sequence"], row["seed"]), np.nan)
        if np.isfinite(difference) and f"{column}{LESS_BASELINE}" in row:
            difference = number(row, f"{column}{LESS_BASELINE}")
        if np.isfinite(difference):
            one = sequence is None and row["sequence"] in recorded
            samples.setdefault((row["sequence"], None if one else row["seed"]), []).append(difference)
    return np.array([np.mean(sample) for sample in samples.values()], float)
