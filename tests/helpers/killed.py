"""A run that is killed after some frames."""

from __future__ import annotations

from dataclasses import dataclass

from vggtgeo.datasets.frame import Frame
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.state import Slam


class Killed(Exception):
    """What ends a run in the middle of everything."""


@dataclass
class KilledAfter(Callback):
    """Ends the run at a frame, before its state is kept."""

    frame: int

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        if frame.index == self.frame:
            raise Killed
