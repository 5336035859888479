"""Depth of every frame of a run: the sensor's own, read once more, and where it has none what keyframes saw there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np

from vggtgeo.datasets import Sequence as Frames
from vggtgeo.geometry.camera import Undistorter
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.frame_depth import FrameDepths
from vggtgeo.models.classical import SensorDepth
from vggtgeo.results.frames_again import read_again
from vggtgeo.slam.state import Slam
from vggtgeo.slam.threads import map_in_threads

AT_ONCE = 16
"""Frames in memory."""


def every_depth(
    slam: Slam, depth_maps: Sequence[DepthMap | None], frames: Frames | None = None
) -> Iterator[tuple[int, DepthMap | None]]:
    """Number and depth of every frame, in their order; see `FrameDepths`.

    slam: after the last adjustment. depth_maps: the keyframes' dense depth. frames: what the run read; the depth of
    those that have some is theirs, undistorted as in the run, with the noise of a depth camera. None: no frame has any.

    Raises:
        InputError: the images of `frames` are of another size than those of the run.

    """
    found, rows = FrameDepths(slam, depth_maps), iter(_own_depths(slam, frames))
    while some := list(islice(rows, AT_ONCE)):
        depths = map_in_threads(lambda pair: found.of(*pair), some)
        yield from ((slam.frames[row].frame, depth) for (row, _), depth in zip(some, depths, strict=True))


def _own_depths(slam: Slam, frames: Frames | None) -> Iterator[tuple[int, DepthMap | None]]:
    """Rows of `slam.frames`, each with the depth that came with the frame."""
    left = set(range(len(slam.frames)))
    if frames is not None and frames.has_depth and slam.metric:
        undistorter, sensor = (slam.camera.lens or frames.camera).undistorter(), SensorDepth()
        for row, frame in read_again(slam, frames):
            left.remove(row)
            yield row, None if frame.depth is None else _measured(frame.image, frame.depth, undistorter, sensor)
    yield from ((row, None) for row in sorted(left))


def _measured(image: np.ndarray, depth: np.ndarray, undistorter: Undistorter, sensor: SensorDepth) -> DepthMap:
    found = sensor.estimate(image, undistorter.depth(depth))
    return DepthMap(found.depth, found.sigma_rel, found.confidence)
