"""Colours of all figures, and the style of their axes."""

from __future__ import annotations

from typing import Any

BLUE, ORANGE, GREEN, INK, RULE, GRID = "#1f5fbf", "#e07b1a", "#3a8f5c", "#333333", "#bbbbbb", "#e3e3e3"
"""The report replaces them by variables of its style sheet."""
LINES = (BLUE, ORANGE, GREEN, "#8e5fb0", "#b0413e", "#7a7a2a", "#3b9aa5", "#a05a2c")
"""Colours of the lines of a figure, in order; repeated if there are more."""


def line_colour(number: int) -> str:
    """Return the colour of a line."""
    return LINES[number % len(LINES)]


def style(axes: Any, **grid: Any) -> None:
    """Style axes. grid: options of `axes.grid`."""
    axes.grid(color=GRID, lw=0.7, **grid)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=9)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=INK, fontsize=9)
    for spine in axes.spines.values():
        spine.set_color(RULE)
