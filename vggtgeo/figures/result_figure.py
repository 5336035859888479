"""The picture of a whole run: its path and its map."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from vggtgeo.figures import map_view
from vggtgeo.figures.plots import NotebookFigure, trajectory_figure
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory

_MAP = 3.6
"""Inches: height of the two views of the map."""


def result_figure(
    trajectory: Trajectory, keyframes: Trajectory, cloud: PointCloud, metric: bool, truth: Trajectory | None = None
) -> NotebookFigure:
    """Trajectory from above and from the side, and the map from behind and from above."""
    figure = trajectory_figure(trajectory, truth, keyframes, not metric, title="", width=9.0)
    if not len(cloud):
        return figure
    width, height = figure.get_size_inches()
    whole = NotebookFigure(figsize=(width, height + _MAP))
    FigureCanvasAgg(whole)
    above, below = whole.subplots(2, 1, height_ratios=[height, _MAP])
    figure.set_dpi(150)
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    views = [view(cloud, trajectory, 700) for view in (map_view.walk_in, map_view.from_above)]
    for axes, picture in ((above, np.asarray(canvas.buffer_rgba())), (below, np.concatenate(views, axis=1))):
        axes.imshow(picture)
        axes.axis("off")
    whole.subplots_adjust(0, 0, 1, 1, 0, 0.01)
    return whole
