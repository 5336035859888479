"""Callbacks of a run: progress bars, viewers, recorders. They do not change the result."""

from __future__ import annotations

from typing import Any

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.slam.state import Slam


class Callback:
    """Hooks of `vggtgeo.reconstruct`, in the order of their calls; each does nothing until a subclass overrides it.

    Example:
        >>> import vggtgeo as vg
        >>> class Progress(vg.Callback):
        ...     def on_frame(self, slam, frame):
        ...         print(f"frame {frame.index}: {slam}")

    """

    def on_warm_up(self, problem: Problem, state: State) -> None:
        """Called before the first frame, to compile for windows of the shape of `problem`."""

    def on_begin(self, name: str, total: int | None) -> None:
        """Called after compilation, before the first frame. total: number of frames, None if unknown."""

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Called with the state after `frame` (as read, before undistortion)."""

    def so_far(self) -> Any:
        """Return data for `on_resume` in a resumed run: numbers, texts, arrays, tuples of them; None: nothing.

        Called between two frames; the result must not be changed later.
        """
        return None

    def on_resume(self, so_far: Any, slam: Slam) -> None:
        """Called after `on_begin` of a resumed run, with the result of `so_far` after the last frame of `slam`."""

    def on_adjust(self, slam: Slam) -> None:
        """Called with the state after the last frame, before the global adjustment."""

    def on_stage(self, name: str) -> None:
        """Called when a stage before the first or after the last frame starts, which may take some seconds."""

    def on_stage_frame(self, done: int, total: int) -> None:
        """Called in a stage that counts frames (self-calibration), after each: `done` of `total`."""

    def on_message(self, message: str) -> None:
        """Called with an urgent message for the user."""

    def on_finish(self, slam: Slam, cloud: PointCloud) -> None:
        """Called with the state after the last adjustment, and the map."""
