"""Frames that were read and are not tracked yet."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace

from vggtgeo.datasets.frame import Frame
from vggtgeo.slam.tracking.tracker import FramePose


class FramesInHand:
    """Frames on their way through the reading thread; the loop takes each, as it was read, once it is tracked.

    Appending to a deque and taking from it need no lock. (A dict, which the loop went through while a frame was put in,
    ended a run now and then.)
    """

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames = frames
        self._read: deque[Frame] = deque()

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._frames:
            self._read.append(frame)
            yield frame

    def take(self, record: FramePose) -> Frame:
        """The frame of a record; those read before it were left out, and are forgotten."""
        while True:
            frame = self._read.popleft()
            if (frame.index, frame.timestamp) == (record.frame, record.timestamp):
                return frame


def read_only(frame: Frame) -> Frame:
    """The frame for others to look at: the map holds its arrays, and who draws into them would change it."""
    views = [None if array is None else array.view() for array in (frame.image, frame.depth)]
    for view in views:
        if view is not None:
            view.setflags(write=False)
    image, depth = views
    assert image is not None
    return replace(frame, image=image, depth=depth)
