"""Read the frames of a run a second time, for files of every frame: a run keeps images of its keyframes only."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np

from vggtgeo.datasets import Frame
from vggtgeo.datasets import Sequence as Frames
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.frame_depth import FrameDepths
from vggtgeo.models.classical import SensorDepth
from vggtgeo.slam.state import Slam
from vggtgeo.slam.threads import map_in_threads

BATCH = 16
"""Frames in memory at a time."""


def reread_frames(slam: Slam, frames: Frames) -> Iterator[tuple[int, Frame]]:
    """Yield each row of `slam.frames` with its frame, as read from `frames`; skip frames that cannot be read.

    Raises:
        InputError: the image size of `frames` differs from that of the run.

    """
    row_of = {record.frame: row for row, record in enumerate(slam.frames)}
    if not row_of:
        return
    height, width = slam.keyframes[0].size
    if (frames.camera.width, frames.camera.height) != (width, height):
        raise InputError(
            f"`frames` has images of {frames.camera.width} x {frames.camera.height} pixels, the run's are "
            f"{width} x {height}; pass the frames that the run read"
        )
    numbers = sorted(row_of)
    stride = int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
    with warnings.catch_warnings():  # the run has reported unreadable frames already
        warnings.simplefilter("ignore", InputWarning)
        for frame in frames.frames(numbers[0], numbers[-1] + 1, stride):
            if frame.index in row_of:
                yield row_of[frame.index], frame


def depth_of_frames(
    slam: Slam, depth_maps: Sequence[DepthMap | None], frames: Frames | None = None
) -> Iterator[tuple[int, DepthMap | None]]:
    """Yield frame number and depth of every frame, in the order of frames; see `FrameDepths`.

    Args:
        slam: state after the last adjustment.
        depth_maps: dense depth of the keyframes.
        frames: what the run read. Its depth images are undistorted as in the run and get the noise of a depth camera;
            keyframe depth fills the rest. None: keyframe depth only.

    Raises:
        InputError: the image size of `frames` differs from that of the run.

    """
    depths, rows = FrameDepths(slam, depth_maps), iter(_sensor_depths(slam, frames))
    while batch := list(islice(rows, BATCH)):
        found = map_in_threads(lambda pair: depths.of(*pair), batch)
        yield from ((slam.frames[row].frame, depth) for (row, _), depth in zip(batch, found, strict=True))


def _sensor_depths(slam: Slam, frames: Frames | None) -> Iterator[tuple[int, DepthMap | None]]:
    """Yield rows of `slam.frames`, each with the frame's depth image, undistorted."""
    left = set(range(len(slam.frames)))
    if frames is not None and frames.has_depth and slam.metric:
        undistorter, sensor = (slam.camera.lens or frames.camera).undistorter(), SensorDepth()
        for row, frame in reread_frames(slam, frames):
            left.remove(row)
            depth = None
            if frame.depth is not None:
                found = sensor.estimate(frame.image, undistorter.depth(frame.depth))
                depth = DepthMap(found.depth, found.sigma_rel, found.confidence)
            yield row, depth
    yield from ((row, None) for row in sorted(left))
