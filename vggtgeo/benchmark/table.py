"""The table of runs, one row each, as CSV and Parquet."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_path
from vggtgeo.models.extras import install_hint

Row = Mapping[str, Any]
"""A row of the table: plain values by column."""

NUMBERS = (
    *("frames", "tracked", "coverage", "keyframes", "matched", "metric", "path_m"),
    *("ate_se3_m", "ate_sim3_m", "scale", "ate_yaw_m", "ate_unaligned_m", "rte_1s_m", "rre_1s_deg"),
    *("rte_1m_m", "rre_1m_deg", "depth_rmse_m", "depth_abs_rel", "depth_below_1_25"),
    *("f_score", "precision", "recall", "mean_distance_m", "accuracy_m", "completeness_m", "threshold_m"),
    *("mesh_f_score", "mesh_accuracy_m", "mesh_completeness_m", "nees_place", "nees_rotation", "focal_error"),
    *("frames_per_second", "seconds_wall", "peak_memory_gb"),
)
"""Numeric columns."""
FIRST = ("suite", "sequence", "setting", "seed", "status", "message", "simulated", "protocol", "verdict", *NUMBERS)
"""Columns that come first, in this order; the others follow by name."""


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
    """The values converted to one type: to float if any is a float, else to text if types differ."""
    if any(isinstance(value, float) for value in column):
        return [float(value) if isinstance(value, int | float) else None for value in column]
    kinds = {type(value) for value in column if value is not None}
    return column if len(kinds) < 2 else [None if value is None else str(value) for value in column]
