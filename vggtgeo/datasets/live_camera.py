"""Live cameras: a webcam (`webcam:0`) or a stream by its address (`rtsp://...`, `http://...`), read by OpenCV."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic
from typing import Any, Self

import cv2

from vggtgeo.datasets.frame import Frame, check_range
from vggtgeo.datasets.intrinsics import guess_with_warning
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

_WEBCAM = re.compile(r"webcam(?::([0-9]{1,9}))?")
_ADDRESS = re.compile(r"[a-z][a-z0-9+.-]*://.+", re.IGNORECASE)


def is_live(text: str) -> bool:
    """Return whether `text` names a webcam or a stream, not a file."""
    return _WEBCAM.fullmatch(text) is not None or _ADDRESS.fullmatch(text) is not None


@dataclass(frozen=True)
class LiveCamera:
    """Frames of a live camera, without depth and ground truth, until the stream ends or the run is interrupted.

    The length is unknown (0). Timestamps are the times of arrival.
    """

    source: str
    camera: Camera
    has_depth: bool = False

    @classmethod
    def open(cls, source: str) -> Self:
        """Open a camera and read one frame for the size; raise InputError if no camera answers."""
        with _capture(source) as capture:
            received, image = capture.read()
        if not received:
            raise InputError(f"`{_without_login(source)}` gives no frame: is the camera connected, and not in use?")
        height, width = image.shape[:2]
        return cls(source, guess_with_warning(_without_login(source), width, height))

    @property
    def name(self) -> str:
        """Return the source without its password."""
        return _without_login(self.source)

    def __len__(self) -> int:
        return 0

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Return the frames start, start + stride, ... below end as they arrive; frames that are not requested in time
        are lost.
        """
        check_range(start, end, stride)
        return self._read(start, end, stride)

    def ground_truth(self) -> Trajectory | None:
        return None

    def _read(self, start: int, end: int | None, stride: int) -> Iterator[Frame]:
        began = last = monotonic()
        with _capture(self.source) as capture:
            for index in range(sys.maxsize if end is None else end):
                if not capture.grab():
                    return
                now = max(monotonic(), last + 1e-6)
                if index >= start and (index - start) % stride == 0:
                    received, image = capture.retrieve()
                    if received:
                        rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
                        yield Frame(index, now - began, rgb, None, f"{self.name}, {index}")
                last = now


def _without_login(source: str) -> str:
    """Return an address without the user's name and password."""
    return re.sub(r"//[^/?#]*@", "//", source)


@contextmanager
def _capture(source: str) -> Iterator[cv2.VideoCapture]:
    webcam = _WEBCAM.fullmatch(source)
    logging: Any = cv2.utils.logging
    level = logging.setLogLevel(logging.LOG_LEVEL_SILENT)  # the error below replaces OpenCV's log lines
    try:
        capture = cv2.VideoCapture(int(webcam.group(1) or 0) if webcam else source)
    finally:
        logging.setLogLevel(level)
    try:
        if not capture.isOpened():
            raise InputError(
                f"`{_without_login(source)}` cannot be opened: is the camera connected, and the address right?"
            )
        yield capture
    finally:
        capture.release()
