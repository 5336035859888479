"""The ablations as a picture: the error of every run, and the mean of each variant."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.ticker import LogLocator, NullFormatter

from vggtgeo.figures.plots import NotebookFigure
from vggtgeo.io.files import atomic_path
from vggtgeo.paper_bench.store import BenchRun
from vggtgeo.paper_bench.tables import ATE, select, values
from vggtgeo.paper_bench.variants import FULL, VARIANTS

_FULL, _OTHER, _INK, _GRID = "#1f5fbf", "#e07b1a", "#333333", "#e3e3e3"
_ROW, _MARGIN = 0.32, 0.9
"""Inches."""


def ablation_figure(results: Sequence[BenchRun], title: str) -> NotebookFigure:
    """ATE (logarithmic) of each variant, one panel a scene: a dot a seed, a bar at the mean."""
    scenes = list(dict.fromkeys(result.scene for result in results))
    rows = {scene: [key for key in VARIANTS if select(results, scene, key)] for scene in scenes}
    heights = [_ROW * len(rows[scene]) + _MARGIN for scene in scenes]
    figure = NotebookFigure(figsize=(8.5, sum(heights) + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(scenes), 1, height_ratios=heights, squeeze=False)[:, 0]
    for axes, scene in zip(panels, scenes, strict=True):
        _draw(axes, results, scene, rows[scene])
    panels[-1].set_xlabel("ATE after SE(3) alignment [cm], simulated; dots: seeds, bars: means")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, color=_INK)
    return figure


def write_figure(path: str | os.PathLike[str], results: Sequence[BenchRun], title: str) -> None:
    """`ablation_figure` as a PNG, atomically."""
    with atomic_path(path) as temporary:
        ablation_figure(results, title).savefig(temporary, dpi=130, format="png", facecolor="white")


def _draw(axes: Any, results: Sequence[BenchRun], scene: str, keys: Sequence[str]) -> None:
    for row, key in enumerate(keys):
        errors = values(select(results, scene, key), ATE)
        colour = _FULL if key == FULL else _OTHER
        axes.plot(errors, np.full(len(errors), row), "o", ms=5, color=colour, alpha=0.55, mec="none")
        axes.plot([errors.mean()] * 2, [row - 0.32, row + 0.32], color=colour, lw=2.5)
        if key == FULL:
            axes.axvline(errors.mean(), color=_FULL, lw=0.8, ls=":")
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yticks(range(len(keys)), [VARIANTS[key].title for key in keys])
    axes.set_ylim(len(keys) - 0.4, -0.6)
    axes.set_title(scene, loc="left", fontsize=10, color=_INK)
    axes.grid(axis="x", color=_GRID, lw=0.7, which="both")
    axes.set_axisbelow(True)
    axes.tick_params(colors=_INK, labelsize=9)
