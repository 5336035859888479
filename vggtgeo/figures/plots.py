"""Style all figures, and draw a trajectory from above and from the side, with the ground truth.

The world frame of a reconstruction is arbitrary, so the vertical is estimated from the cameras. Hand-held cameras have
little roll, so up is the direction most nearly orthogonal to all image rows. If the camera hardly rotates, its pitch is
unknown. Then up is the axis of the ground truth's world nearest to the mean up of the images; without ground truth it
is that mean, and the figure's title says so. The longest horizontal extent is along the x axis.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vggtgeo.evaluation import AbsoluteError, absolute_error, associate
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

BLUE, ORANGE, GREEN, INK, RULE, GRID = "#1f5fbf", "#e07b1a", "#3a8f5c", "#333333", "#bbbbbb", "#e3e3e3"
"""The report replaces them by variables of its style sheet."""
LINES = (BLUE, ORANGE, GREEN, "#8e5fb0", "#b0413e", "#7a7a2a", "#3b9aa5", "#a05a2c")
"""Colours of the lines of a figure, in order; repeated if there are more."""
_WIDTH = 11.0
"""Inches."""
_WEIGHT_OF_MEAN_UP = 0.02
"""Weight of the mean up of the images against the scatter of the image rows, whose eigenvalues are at most 1."""
_MIN_YAW = 0.05
"""Second eigenvalue of the image rows' scatter above which rotations define up: 13 degrees RMS of yaw. Below, the mean
up of the images has more than a third of the weight."""
_MIN_EXTENT = 0.1
"""Minimum extent of a figure, metres, for a camera that does not move."""


class NotebookFigure(Figure):
    """A figure that a notebook displays, with or without pyplot."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=100, facecolor="white")
        return buffer.getvalue()


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


@dataclass(frozen=True, eq=False)
class _Aligned:
    """The estimate aligned to the ground truth, the ground truth, and the error that is left."""

    estimate: Trajectory
    keyframes: Float[np.ndarray, "k 3"]
    truth: Trajectory | None
    error: AbsoluteError | None


def trajectory_figure(
    estimate: Trajectory,
    truth: Trajectory | None = None,
    keyframes: Trajectory | None = None,
    with_scale: bool = False,
    title: str | None = "",
    width: float = _WIDTH,
    metres: bool = True,
) -> NotebookFigure:
    """Return the top and side view of `estimate`, with equal axes, `width` inches wide; `keyframes` are marked.

    With `truth`, the estimate is aligned to it by SE(3), or by Sim(3) if `with_scale` or the ground truth is not in
    `metres`. The title then has the ATE of the poses that match in time; if too few match, `truth` is left out. Without
    a title if `title` is None. Raises InputError for an empty estimate.
    """
    if len(estimate) == 0:
        raise InputError("`estimate` must have at least one pose, got none")
    drawn = _align(estimate, truth, keyframes, with_scale or not metres)
    in_metres = metres if drawn.error else not with_scale
    figure = _draw(drawn, "m" if in_metres else "unit of the ground truth" if drawn.error else "no unit", width)
    if title is not None:
        figure.suptitle(_title(drawn, title, with_scale, metres), x=0.01, ha="left", fontsize=12, color=INK)
    return figure


def _align(estimate: Trajectory, truth: Trajectory | None, keyframes: Trajectory | None, with_scale: bool) -> _Aligned:
    places = np.zeros((0, 3)) if keyframes is None else keyframes.positions
    if truth is None:
        return _Aligned(estimate, places, None, None)
    try:
        error = absolute_error(*associate(estimate, truth), "sim3" if with_scale else "se3")
    except InputError:
        return _Aligned(estimate, places, None, None)
    alignment = error.alignment
    inside = (truth.timestamps >= estimate.timestamps[0]) & (truth.timestamps <= estimate.timestamps[-1])
    return _Aligned(alignment.trajectory(estimate), alignment.points(places), truth.select(inside), error)


def view_axes(trajectory: Trajectory, level_world: bool = False) -> Float[np.ndarray, "3 3"]:
    """Estimate a level frame from the cameras: rows are the longest horizontal direction, the other one, and up.

    The frame is right-handed. level_world: whether an axis of the world is vertical, as in benchmarks; used if the
    cameras rotate too little.
    """
    up = _up(trajectory)
    if level_world and not _has_yaw(trajectory):
        axis = np.argmax(np.abs(up))
        up = np.sign(up[axis]) * np.eye(3)[axis]
    centred = trajectory.positions - trajectory.positions.mean(axis=0)
    horizontal = centred - np.outer(centred @ up, up)
    along = np.linalg.svd(horizontal, full_matrices=True)[2][0] if len(trajectory) > 1 else np.zeros(3)
    along = along - (along @ up) * up
    if np.linalg.norm(along) < 0.1:  # vertical motion only: any horizontal direction
        along = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    along /= np.linalg.norm(along)
    if (trajectory.positions[-1] - trajectory.positions[0]) @ along < 0:
        along = -along
    return np.stack([along, np.cross(up, along), up])


def _has_yaw(trajectory: Trajectory) -> bool:
    """Return whether the cameras rotate enough for their image rows to span the horizontal plane."""
    rows = trajectory.rotations[:, :, 0]
    return bool(np.linalg.eigvalsh(rows.T @ rows / len(rows))[1] > _MIN_YAW)


def _up(trajectory: Trajectory) -> Float[np.ndarray, "3"]:
    rows, mean_up = trajectory.rotations[:, :, 0], -trajectory.rotations[:, :, 1].mean(axis=0)
    doubt = np.eye(3) * (mean_up @ mean_up) - np.outer(mean_up, mean_up)
    up = np.linalg.eigh(rows.T @ rows / len(rows) + _WEIGHT_OF_MEAN_UP * doubt)[1][:, 0]
    return up if up @ mean_up >= 0 else -up


def _draw(drawn: _Aligned, unit: str, width: float) -> NotebookFigure:
    seen = drawn.truth or drawn.estimate
    axes_of_view, origin = view_axes(seen, level_world=drawn.truth is not None), seen.positions[0]
    side_title = "seen from the side" + ("" if drawn.truth or _has_yaw(seen) else "; up is the mean up of the images")
    everything = [drawn.estimate.positions] + ([drawn.truth.positions] if drawn.truth else [])
    points = (np.concatenate(everything) - origin) @ axes_of_view.T
    low, high = points.min(axis=0), points.max(axis=0)
    span = max(float((high - low).max()), _MIN_EXTENT)
    extent = np.maximum(high - low, 0.15 * span)
    low, high = 0.5 * (low + high) - 0.56 * extent, 0.5 * (low + high) + 0.56 * extent
    heights = high - low
    panel = min(0.85 * width * (heights[1] + heights[2]) / heights[0], 0.82 * width)
    figure = NotebookFigure(figsize=(width, panel + 2.2), layout="constrained")
    top, side = figure.subplots(2, 1, height_ratios=[heights[1], heights[2]], sharex=True)
    for axes, vertical, name in ((top, 1, "seen from above"), (side, 2, side_title)):
        _draw_view(axes, drawn, origin, axes_of_view[[0, vertical]])
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[vertical], high[vertical])
        axes.set_ylabel(f"{'across' if vertical == 1 else 'up'} [{unit}]")
        axes.set_title(name, loc="left", fontsize=10, color=INK)
    side.set_xlabel(f"along the longest extent [{unit}]")
    handles, labels = top.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=len(labels), frameon=False, fontsize=9)
    return figure


def _draw_view(axes: Any, drawn: _Aligned, origin: np.ndarray, rows: np.ndarray) -> None:
    flat = lambda points: rows @ (points - origin).T
    path = flat(drawn.estimate.positions)
    if drawn.truth is not None:
        axes.plot(*flat(drawn.truth.positions), color=ORANGE, lw=2.2, alpha=0.9, label="ground truth", zorder=2)
    axes.plot(*path, color=BLUE, lw=1.3, label="estimate", zorder=3)
    if len(drawn.keyframes):
        axes.plot(*flat(drawn.keyframes), ".", color=BLUE, ms=5, label="keyframes", zorder=4)
    axes.plot(*path[:, 0], "o", color="white", mec=INK, mew=1.5, ms=9, label="start", zorder=5)
    axes.plot(*path[:, -1], "s", color=INK, mec="white", mew=1.0, ms=9, label="end", zorder=5)
    axes.set_aspect("equal", adjustable="box")
    style(axes)


def _title(drawn: _Aligned, title: str, with_scale: bool, metres: bool) -> str:
    if drawn.error is None:
        facts = f"{len(drawn.estimate)} pose{'s' if len(drawn.estimate) > 1 else ''}, no ground truth"
        if not with_scale:
            facts += f", path {drawn.estimate.length:.2f} m"
    else:
        alignment = "SE(3)" if metres and not with_scale else "Sim(3)"
        statistics = drawn.error.statistics
        error = f"{100 * statistics.rmse:.2f} cm" if metres else f"{statistics.rmse:.4g}"
        facts = f"ATE {error} after {alignment} ({statistics.count} poses)"
    return f"{title}:  {facts}" if title else facts
