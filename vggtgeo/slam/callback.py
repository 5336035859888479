"""Callbacks of a run: progress bars, viewers, recorders. None of them changes the result."""

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
        """Before the first frame: compile for windows of the shape of `problem`."""

    def on_begin(self, name: str, total: int | None) -> None:
        """Everything is compiled; frames come next: `total` of them, None where nobody knows."""

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """The state after `frame` (as it was read, before undistortion)."""

    def so_far(self) -> Any:
        """What a run that is killed and resumed must hand to `on_resume`: numbers, texts, arrays, tuples of them. Asked
        between two frames; what is given is never changed later. None: nothing.
        """
        return None

    def on_resume(self, so_far: Any, slam: Slam) -> None:
        """After `on_begin`, where a run goes on: what `so_far` gave after the last frame of `slam`."""

    def on_adjust(self, slam: Slam) -> None:
        """The state after the last frame, before the adjustment of the whole map."""

    def on_stage(self, name: str) -> None:
        """A stage after the last frame begins, which may take some seconds."""

    def on_message(self, message: str) -> None:
        """Something that the user should know at once."""

    def on_finish(self, slam: Slam, cloud: PointCloud) -> None:
        """The state after the last adjustment, and the map."""
