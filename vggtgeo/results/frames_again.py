"""The frames of a run, read once more after it: for files of every frame, of which a run keeps no pictures."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from vggtgeo.datasets import Frame
from vggtgeo.datasets import Sequence as Frames
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.slam.state import Slam


def read_again(slam: Slam, frames: Frames) -> Iterator[tuple[int, Frame]]:
    """Rows of `slam.frames`, each with its frame as it was read, in their order; those that cannot be read are left
    out.

    Raises:
        InputError: the images of `frames` are of another size than those of the run.

    """
    row_of = {record.frame: row for row, record in enumerate(slam.frames)}
    if not row_of:
        return
    height, width = slam.keyframes[0].size
    if (frames.camera.width, frames.camera.height) != (width, height):
        raise InputError(
            f"`frames` are of {frames.camera.width} x {frames.camera.height} pixels, those of the run of "
            f"{width} x {height}; give the frames that the run read"
        )
    with warnings.catch_warnings():  # what cannot be read was told when the run came to it
        warnings.simplefilter("ignore", InputWarning)
        for frame in frames.frames(min(row_of), max(row_of) + 1, _step(list(row_of))):
            if frame.index in row_of:
                yield row_of[frame.index], frame


def _step(numbers: list[int]) -> int:
    """The stride that a run took frames with."""
    return int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
