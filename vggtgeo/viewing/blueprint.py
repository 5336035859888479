"""How a recording opens: the world at the left, the current keyframe's pictures at the right, curves below."""

from __future__ import annotations

from typing import Any

ORIGINS = (
    *("/world", "/world/camera/image", "/keyframe/image", "/keyframe/depth", "/keyframe/confidence", "/window"),
    *("/plots/residuals", "/plots/solver", "/plots/convergence", "/plots/tracking", "/notes"),
)
"""Where the views look."""


def blueprint() -> Any:
    """The arrangement of the views; entities are those of `vggtgeo/viewing/entities.py`."""
    import rerun.blueprint as rrb

    world = rrb.Spatial3DView(
        name="World: path, map, covariance ellipsoids of 20 sigma",
        origin="/world",
        line_grid=rrb.LineGrid3D(visible=False),
    )
    pictures = rrb.Tabs(
        rrb.Spatial2DView(name="Matches and lines", origin="/keyframe/image"),
        rrb.Spatial2DView(name="Depth", origin="/keyframe/depth"),
        rrb.Spatial2DView(name="Confidence", origin="/keyframe/confidence"),
        rrb.GraphView(name="Window and covisibility", origin="/window"),
        name="Keyframe",
    )
    now = rrb.Spatial2DView(name="Frame", origin="/world/camera/image")
    curves = rrb.Tabs(
        rrb.TimeSeriesView(name="Residuals [px], depth [sigma]", origin="/plots/residuals"),
        rrb.TimeSeriesView(name="Energy by iteration", origin="/plots/solver"),
        rrb.TimeSeriesView(name="Damping, gradient, step [m]: log10", origin="/plots/convergence"),
        rrb.TimeSeriesView(name="Tracked points", origin="/plots/tracking"),
        rrb.TextLogView(name="Notes", origin="/notes"),
    )
    left = rrb.Vertical(world, curves, row_shares=[3, 1])
    right = rrb.Vertical(now, pictures, row_shares=[1, 1])
    time = rrb.TimePanel(timeline="frame", play_state="following")  # opens at the end, where the map is whole
    return rrb.Blueprint(rrb.Horizontal(left, right, column_shares=[2, 1]), time, collapse_panels=True)
