"""Means and standard deviations over seeds, as Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from vggtgeo.paper_bench.measure import Errors
from vggtgeo.paper_bench.plan import OURS, TABLE_6, Plan
from vggtgeo.paper_bench.store import BenchRun
from vggtgeo.paper_bench.variants import FULL, VARIANTS


@dataclass(frozen=True)
class Column:
    """A column of a table: a number of `Errors` in the unit of its head."""

    head: str
    field: str
    factor: float = 1.0
    digits: int = 2


ATE = Column("ATE cm", "ate_m", 100.0)
COLUMNS = (
    ATE,
    Column("ATE Sim(3) cm", "ate_sim3_m", 100.0),
    Column("RTE cm/s", "rte_m", 100.0),
    Column("RRE deg/s", "rre_deg"),
    Column("depth RMSE cm", "depth_rmse_m", 100.0),
    Column("depth before cm", "depth_prior_rmse_m", 100.0),
)


def select(results: Sequence[BenchRun], scene: str, variant: str) -> list[BenchRun]:
    """The results of one scene and variant, by seed."""
    chosen = [r for r in results if (r.scene, r.variant) == (scene, variant)]
    return sorted(chosen, key=lambda result: result.seed)


def values(results: Sequence[BenchRun], column: Column) -> np.ndarray:
    """The column's numbers, float64 [n], in its unit."""
    return np.array([column.factor * getattr(result.errors, column.field) for result in results], float)


def spread(numbers: np.ndarray) -> float:
    """Sample standard deviation; NaN for fewer than two."""
    return float(np.std(numbers, ddof=1)) if len(numbers) > 1 else float("nan")


def cell(numbers: np.ndarray, digits: int = 2) -> str:
    """Mean and standard deviation as text."""
    if not len(numbers):
        return ""
    deviation = spread(numbers)
    mean = f"{numbers.mean():.{digits}f}"
    return mean if np.isnan(deviation) else f"{mean} +- {deviation:.{digits}f}"


def paired(results: Sequence[BenchRun], scene: str, variant: str, column: Column = ATE) -> np.ndarray:
    """Variant minus full system, seed by seed, over the seeds that both have; float64 [n]."""
    full = {result.seed: result for result in select(results, scene, FULL)}
    own = [result for result in select(results, scene, variant) if result.seed in full]
    return values(own, column) - values([full[result.seed] for result in own], column)


def markdown(plan: Plan, results: Sequence[BenchRun]) -> str:
    """All tables of a plan."""
    scenes = list(dict.fromkeys(course.scene for course in plan.courses()))
    parts = [
        f"Simulated: rendered worlds, stubs of the five roles with stated error models. Plan `{plan.name}`, seeds from "
        f"{plan.first_seed}; mean +- standard deviation over seeds.",
        "\n".join(f"- {course.text}" for course in plan.courses()),
        "### Accuracy of the full system (the paper's Tables 1 and 2), simulated",
        _accuracy(results, scenes),
    ]
    if any(result.variant in TABLE_6[1:] for result in results):
        parts += ["### Ablations (the paper's Table 6), simulated", _comparison(results, scenes, TABLE_6)]
    if any(result.variant in OURS for result in results):
        parts += ["### Further comparisons, simulated", _comparison(results, scenes, (FULL, *OURS))]
    return "\n\n".join(parts) + "\n"


def _accuracy(results: Sequence[BenchRun], scenes: Sequence[str]) -> str:
    lines = ["| scene | seeds | path m | " + " | ".join(column.head for column in COLUMNS) + " |"]
    lines.append("|---|---|---|" + "---|" * len(COLUMNS))
    for scene in scenes:
        own = select(results, scene, FULL)
        if own:
            length = cell(values(own, Column("", "path_m")), 1)
            cells = [cell(values(own, column), column.digits) for column in COLUMNS]
            lines.append("| " + " | ".join([scene, str(len(own)), length, *cells]) + " |")
    return "\n".join(lines)


def _comparison(results: Sequence[BenchRun], scenes: Sequence[str], variants: Sequence[str]) -> str:
    """ATE of each variant, and by how much it is worse than the full system on the same seeds."""
    head = (
        *("scene", "variant", "seeds", "ATE cm", "worse than full by cm", "times"),
        *("ATE Sim(3) cm", "worse than full by cm", "RRE deg/s", "depth RMSE cm"),
    )
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for scene in scenes:
        if not any(select(results, scene, key) for key in variants if key != FULL):
            continue
        for key in variants:
            own = select(results, scene, key)
            if own:
                lines.append("| " + " | ".join(_comparison_row(results, own, scene, key)) + " |")
    return "\n".join(lines)


def _comparison_row(results: Sequence[BenchRun], own: Sequence[BenchRun], scene: str, key: str) -> list[str]:
    difference = paired(results, scene, key)
    ratio = ""
    if key != FULL and len(difference):
        mine = values(own, ATE)[: len(difference)]
        ratio = f"{mine.mean() / (mine - difference).mean():.2f}"
    return [
        *(scene, VARIANTS[key].title, str(len(own)), cell(values(own, ATE))),
        "" if key == FULL else cell(difference),
        ratio,
        cell(values(own, COLUMNS[1])),
        "" if key == FULL else cell(paired(results, scene, key, COLUMNS[1])),
        cell(values(own, COLUMNS[3])),
        cell(values(own, COLUMNS[4])),
    ]


def as_csv(results: Sequence[BenchRun]) -> str:
    """Every run, one a line; SI units and degrees."""
    names = [field.name for field in fields(Errors)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["simulated", "scene", "variant", "seed", *names])
    for result in sorted(results, key=lambda r: (r.scene, list(VARIANTS).index(r.variant), r.seed)):
        writer.writerow(
            [True, result.scene, result.variant, result.seed, *(getattr(result.errors, name) for name in names)]
        )
    return text.getvalue()
