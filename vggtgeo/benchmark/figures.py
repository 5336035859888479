"""Figures of a suite: ablations, paths, errors over time, run time and memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from vggtgeo.benchmark import tables
from vggtgeo.benchmark.rows import Row, Summary, run_name, select, values
from vggtgeo.benchmark.suite import Suite
from vggtgeo.datasets.pose_files import load_trajectory
from vggtgeo.evaluation import absolute_error, associate
from vggtgeo.figures.plots import BLUE, INK, ORANGE, RULE, NotebookFigure, line_colour, style, view_axes
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

_ROW, _LINE, _MARGIN = 0.3, 0.15, 0.9
"""Height of a row, of a further line of its label, and of the margins of a panel, inches."""
_LABEL, _TITLE, _ENTRY = 30, 60, 44
"""Maximum letters in a line of an axis label, a title, a legend entry: longer ones leave no room for the axes."""
_MIN_SPAN = 2.5
"""Minimum ratio of the ends of an axis of errors, so that tiny differences look tiny, and a tick at 1, 2 or 5 is
visible."""
_MAX_LINES = 8
MIN_POSES = 3
"""Minimum number of poses of a path: fewer cannot be aligned."""


def ablation_figure(suite: Suite, rows: Sequence[Row], width: float = 8.5) -> NotebookFigure:
    """Draw the error of each setting on a logarithmic axis, one panel for each sequence.

    A dot is a run, a bar the mean with its 95 % interval.
    """
    good = [row for row in rows if row["status"] == "ok"]
    column = headline(good)
    panels = {
        name: [key for key in tables.settings_of(suite, good) if np.isfinite(_errors(good, name, key, column)).any()]
        for name in tables.sequences_of(suite, good)
    }
    panels = {name: keys for name, keys in panels.items() if keys}
    coverage = lambda own: "" if tables.is_covered(own) else tables.at_coverage(own)  # shown only if it is too small
    label = lambda name, key: f"{suite.title_of(key)}{coverage(select(good, name, key))}"
    rows_of = {name: [_wrapped(label(name, key), _LABEL) for key in keys] for name, keys in panels.items()}
    heights = [_height(labels) + _MARGIN for labels in rows_of.values()]
    figure = NotebookFigure(figsize=(width, sum(heights) + 0.5 if panels else 1.5), layout="constrained")
    if not panels:
        return figure
    drawn = figure.subplots(len(panels), 1, height_ratios=heights, squeeze=False)[:, 0]
    for axes, (name, keys) in zip(drawn, panels.items(), strict=True):
        _draw_panel(axes, suite, [_errors(good, name, key, column) for key in keys], keys)
        axes.set_yticks(range(len(keys)), rows_of[name])
        axes.set_title(_wrapped(name, _TITLE), loc="left", fontsize=10, color=INK)
    drawn[-1].set_xlabel(f"{column.head}; dots: runs, bars: means with 95 % intervals", fontsize=9, color=INK)
    return figure


def _wrapped(text: str, width: int) -> str:
    """Wrap into at most three lines of at most `width` letters."""
    return "\n".join(wrap(text.replace("`", ""), width, max_lines=3, placeholder=" ..."))


def _height(labels: Sequence[str]) -> float:
    """Return the height of a panel, inches; all rows have the height of the longest label."""
    return (_ROW + _LINE * max((label.count("\n") for label in labels), default=0)) * len(labels)


def headline(rows: Sequence[Row]) -> tables.Column:
    """Return the error to draw: after SE(3) if every run is metric, else after Sim(3)."""
    metric = all(row.get("metric") is not False and not row.get("external") for row in rows)
    return tables.SE3 if metric else tables.SIM3


def _errors(rows: Sequence[Row], sequence: str, setting: str, column: tables.Column) -> np.ndarray:
    found = column.factor * values(tables.comparable(select(rows, sequence, setting), column), column.name)
    return np.asarray(found[np.isfinite(found) & (found > 0)])


def _draw_panel(axes: Any, suite: Suite, errors: Sequence[np.ndarray], keys: Sequence[str]) -> None:
    for row, (key, numbers) in enumerate(zip(keys, errors, strict=True)):
        colour = BLUE if key == suite.base else ORANGE
        summary = Summary.of(numbers)
        axes.plot(numbers, np.full(len(numbers), row), "o", ms=5, color=colour, alpha=0.55, mec="none")
        axes.plot([summary.mean] * 2, [row - 0.32, row + 0.32], color=colour, lw=2.5)
        if np.isfinite(summary.half):
            low = max(summary.mean - summary.half, 0.3 * float(numbers.min()))
            axes.plot([low, summary.mean + summary.half], [row, row], color=colour, lw=1.2)
        if key == suite.base:
            axes.axvline(summary.mean, color=BLUE, lw=0.8, ls=":")
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    wider = max(np.sqrt(_MIN_SPAN * low / high), 1.0)
    axes.set_xlim(low / wider, high * wider)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(len(keys) - 0.4, -0.6)
    style(axes, axis="x", which="both")


@dataclass(frozen=True, eq=False)
class AlignedPath:
    """An aligned estimate, the ground truth, and the error of each pose, metres."""

    title: str
    estimate: Trajectory
    truth: Trajectory
    errors: np.ndarray


def paths(suite: Suite, rows: Sequence[Row], sequence: str, folder: Path) -> list[AlignedPath]:
    """Return for each setting the first run on a sequence whose trajectory can be aligned with the ground truth."""
    found: list[AlignedPath] = []
    for setting in tables.settings_of(suite, rows):
        drawn = (_path(suite, row, folder) for row in select(rows, sequence, setting))
        found += islice((one for one in drawn if one is not None), 1)
    return found[:_MAX_LINES]


def _path(suite: Suite, row: Row, folder: Path) -> AlignedPath | None:
    """Return the aligned trajectory of a run; None if it has none, or too few poses with ground truth."""
    runs, name = folder / "runs", run_name(row)
    own, others = runs / name / "truth.txt", sorted(runs.glob(f"{row['sequence']}.*.{row['seed']}/truth.txt"))
    try:
        truth = Trajectory.load_tum(own if own.is_file() or not others else others[0])
        estimate = load_trajectory(row.get("external") or runs / name / "estimate.txt", truth)
        matched, reference = associate(estimate, truth)
        error = absolute_error(matched, reference, "sim3" if row.get("metric") is False else "se3")
    except InputError:
        return None
    if len(matched) < MIN_POSES:
        return None
    title = suite.title_of(str(row["setting"])).replace("`", "")
    return AlignedPath(title, error.alignment.trajectory(matched), truth, error.errors)


def paths_figure(given: Sequence[AlignedPath]) -> NotebookFigure:
    """Draw the paths and the ground truth from above, and the errors over time."""
    figure = NotebookFigure(figsize=(5.0, 6.25), layout="constrained")
    above, along = figure.subplots(2, 1, height_ratios=(2.0, 1.0))
    view, origin = view_axes(given[0].truth, level_world=True), given[0].truth.positions[0]
    flat = lambda trajectory: ((trajectory.positions - origin) @ view.T)[:, :2].T
    above.plot(*flat(given[0].truth), color=INK, lw=1.0, ls="--", label="truth")
    for number, one in enumerate(given):
        colour = line_colour(number)
        above.plot(*flat(one.estimate), color=colour, lw=1.2, label=_wrapped(one.title, _ENTRY))
        along.plot(one.estimate.timestamps - one.truth.timestamps[0], 100 * one.errors, color=colour, lw=1.0)
    above.set_aspect("equal", adjustable="datalim")
    above.set_xlabel("m")
    above.legend(frameon=False, fontsize=8, labelcolor=INK, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.1))
    along.set_xlabel("seconds")
    along.set_ylabel("error cm")
    along.set_ylim(bottom=0)
    for axes in (above, along):
        style(axes)
    return figure


_TOTALS = frozenset({"seconds_all", "seconds_wall", "seconds_process"})


def cost_figure(suite: Suite, rows: Sequence[Row], width: float = 8.5) -> NotebookFigure:
    """Draw mean seconds of each stage and mean peak memory, one row for each sequence and setting."""
    groups = [
        (_wrapped(f"{sequence}, {suite.title_of(setting)}", _LABEL), own)
        for sequence in tables.sequences_of(suite, rows)
        for setting in tables.settings_of(suite, rows)
        if (own := [row for row in select(rows, sequence, setting) if not row.get("external")])
    ]
    names = {name for row in rows for name in row if name.startswith("seconds_")} - _TOTALS
    totals = {name: float(np.nansum([_mean(own, name) for _, own in groups])) for name in names}
    stages = [
        name for name in sorted(names, key=lambda name: -totals[name]) if totals[name] > 0.01 * sum(totals.values())
    ]
    figure = NotebookFigure(figsize=(width, _height([name for name, _ in groups]) + 1.6), layout="constrained")
    time, memory = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True)
    left = np.zeros(len(groups))
    for number, name in enumerate(stages):
        seconds = np.nan_to_num([_mean(own, name) for _, own in groups])
        label = name.removeprefix("seconds_").replace("_", " ")
        time.barh(range(len(groups)), seconds, left=left, color=line_colour(number), height=0.6, label=label)
        left += seconds
    memory.barh(range(len(groups)), [_mean(own, "peak_memory_gb") for _, own in groups], color=RULE, height=0.6)
    time.set_yticks(range(len(groups)), [name for name, _ in groups])
    time.set_ylim(len(groups) - 0.4, -0.6)
    time.set_xlabel("seconds, by stage")
    memory.set_xlabel("memory GB")
    for axes in (time, memory):
        style(axes)
    if stages:
        figure.legend(loc="outside lower center", frameon=False, fontsize=8, labelcolor=INK, ncols=5)
    return figure


def _mean(rows: Sequence[Row], column: str) -> float:
    return Summary.of(values(rows, column)).mean
