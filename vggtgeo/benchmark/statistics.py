"""Means, standard deviations and paired differences, with Student intervals for few runs."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from vggtgeo.benchmark.table import Row, number

LEVEL = 0.95
LESS_BASELINE = "_less_baseline"
"""Suffix of a column: the difference to the baseline over the common time."""
SAME = 1e-6
"""Relative spread below which numbers are equal: the runs had no random part."""


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
        half = float(student.ppf(0.5 + LEVEL / 2, count - 1)) * deviation / np.sqrt(count) if count > 1 else np.nan
        return cls(count, float(known.mean()), deviation, float(half), float(np.median(known)))

    @property
    def differs(self) -> bool:
        """Whether the interval excludes zero. Never for equal numbers: seeds without effect do not sample the noise."""
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
    """Return setting minus baseline on the same sequence and seed; over the common time where a row has that.

    recorded: sequences that are the same for every seed. In a mean over sequences, such a sequence is one sample (the
    mean over its seeds): ten seeds of two recordings are not twenty independent recordings.
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
