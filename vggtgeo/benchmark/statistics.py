"""Means, deviations, and differences run by run, with the intervals that few runs allow."""

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
"""Behind the name of a column: the difference to the baseline over what both cover, where that was measured."""
SAME = 1e-6
"""Relative spread below which numbers are the same: nothing was drawn at random."""


@dataclass(frozen=True)
class Summary:
    """Of n numbers: mean, sample standard deviation (NaN for one), the half width of the 95 % interval of the mean by
    Student's law (NaN for one), and median.
    """

    count: int
    mean: float
    deviation: float
    half: float
    median: float

    @classmethod
    def of(cls, values: Float[np.ndarray, " n"]) -> Self:
        """The summary of those `values` that are numbers."""
        known = values[np.isfinite(values)]
        count = len(known)
        if not count:
            return cls(0, np.nan, np.nan, np.nan, np.nan)
        deviation = float(np.std(known, ddof=1)) if count > 1 else np.nan
        half = float(student.ppf(0.5 + LEVEL / 2, count - 1)) * deviation / np.sqrt(count) if count > 1 else np.nan
        return cls(count, float(known.mean()), deviation, float(half), float(np.median(known)))

    @property
    def differs(self) -> bool:
        """Whether zero lies outside of the interval. Numbers that agree to the last digit have none: seeds that change
        nothing say nothing of chance.
        """
        return bool(abs(self.mean) > self.half > SAME * abs(self.mean))


def select(rows: Sequence[Row], sequence: str | None = None, setting: str | None = None) -> list[Row]:
    """Rows of a sequence and a setting, by sequence and seed."""
    chosen = [
        row
        for row in rows
        if (sequence is None or row["sequence"] == sequence) and (setting is None or row["setting"] == setting)
    ]
    return sorted(chosen, key=lambda row: (str(row["sequence"]), int(row["seed"])))


def values(rows: Sequence[Row], column: str) -> Float[np.ndarray, " n"]:
    """A column, NaN where a run has no value."""
    return np.array([number(row, column) for row in rows], float)


def paired(
    rows: Sequence[Row],
    setting: str,
    baseline: str,
    column: str,
    sequence: str | None = None,
    recorded: Collection[str] = (),
) -> Float[np.ndarray, " n"]:
    """Setting minus baseline on the same sequence and seed, where both have a number; over what both cover, where a row
    has that difference.

    recorded: sequences of which there is one, whatever the seed. Over several sequences such a one is one sample, the
    mean over its seeds: ten seeds of two recordings are no twenty recordings.
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
