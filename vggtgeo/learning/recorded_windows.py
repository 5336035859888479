"""Windows of a recording with depth and ground truth, with matches of a tracker, for learning on real images.

As `tracked_windows`, but a match is correct if depth camera and true poses project the corner to it. Both have errors,
which confidences cannot reduce: pose errors fall less than in simulation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vggtgeo.datasets.frame import Frame, Sequence
from vggtgeo.evaluation.association import nearest_in_time
from vggtgeo.geometry import rigid
from vggtgeo.io.errors import InputError
from vggtgeo.learning.tracked_windows import TrackedWindow, track_window

SAME_SURFACE = 0.05
"""Relative difference of depth up to which two frames see the same surface."""
DEPTH_SIGMA = 0.02
"""Relative standard deviation of the depth prior: that of indoor depth cameras at some metres."""
SAME_TIME = 0.02
"""Largest time between a frame and its true pose, seconds."""
MIN_MATCHES = 12
"""Of each keyframe of a window, in and out: fewer hardly determine its pose."""
_TRIES = 20
"""Random positions per window: at some, tracking fails or depth is missing."""


@dataclass(frozen=True, eq=False)
class RecordedTruth:
    """Ground truth of some undistorted frames with depth, by index in `frames`.

    poses: world -> camera, float64 [n, 4, 4]. intrinsics: fx, fy, cx, cy, pixels.
    """

    frames: tuple[Frame, ...]
    poses: np.ndarray
    intrinsics: np.ndarray

    def image(self, index: int) -> np.ndarray:
        """Return the image, uint8 [H, W, 3]."""
        return self.frames[index].image

    def depth(self, index: int) -> np.ndarray:
        """Return the measured depth [H, W], metres, NaN = none."""
        depth = self.frames[index].depth
        assert depth is not None
        return depth

    def pose(self, index: int) -> np.ndarray:
        """Return world -> camera, float64 [4, 4]."""
        return np.asarray(self.poses[index])

    def correspond(self, index_i: int, index_j: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project `pixels` [n, 2] of frame i into frame j: float64 [n, 2], NaN without depth; and whether they are not
        occluded there, bool [n].
        """
        inverse = 1 / _nearest(self.depth(index_i), pixels)
        known = np.isfinite(inverse)
        points = rigid.unproject(pixels[known], inverse[known], self.pose(index_i), self.intrinsics)
        target, shown = np.full(pixels.shape, np.nan), np.zeros(len(pixels), bool)
        target[known] = rigid.project(points, self.pose(index_j), self.intrinsics)
        expected = (points @ self.pose(index_j)[2, :3]) + self.pose(index_j)[2, 3]
        measured = _nearest(self.depth(index_j), target[known])
        shown[known] = (expected > 0) & ~(measured < (1 - SAME_SURFACE) * expected)
        return target, shown


def recorded_windows(
    sequence: Sequence, count: int, *, keyframes: int = 4, points: int = 24, spacing: int = 3, seed: int = 0
) -> Iterator[TrackedWindow]:
    """Yield `count` windows at random positions of a recording with depth and ground truth.

    Args:
        sequence: the recording, for example of `vggtgeo.open_sequence`.
        count: number of windows; fewer if too few positions have depth, ground truth and corners that can be tracked.
        keyframes: per window.
        points: hosted in each keyframe.
        spacing: frames from keyframe to keyframe.
        seed: of positions, corners and noise.

    Raises:
        InputError: the recording has no depth or no truth, or is shorter than a window.

    Example:
        >>> import vggtgeo as vg
        >>> from vggtgeo.learning import recorded_windows
        >>> window = next(recorded_windows(vg.simulate("room", 40, size=(160, 120)), 1, points=8))
        >>> window.features.shape[1], len(window.images)
        (8, 4)

    """
    truth = sequence.ground_truth()
    if truth is None or not sequence.has_depth:
        missing = "true poses" if truth is None else "depth"
        raise InputError(f"`sequence` ({sequence.name}) has no {missing}; learning needs depth and ground truth")
    span = spacing * (keyframes - 1) + 1
    if len(sequence) < span:
        raise InputError(f"`sequence` ({sequence.name}) has {len(sequence)} frames; a window spans {span}")
    rng = np.random.default_rng([seed, 6])
    undistorter = sequence.camera.undistorter()
    found = 0
    for _ in range(_TRIES * count):
        if found == count:
            return
        first = int(rng.integers(0, len(sequence) - span + 1))
        frames = [
            Frame(f.index, f.timestamp, undistorter.image(f.image), undistorter.depth(f.depth), f.name)
            for f in sequence.frames(first, first + span, spacing)
            if f.depth is not None
        ]
        rows, nearest = nearest_in_time(np.array([f.timestamp for f in frames]), truth.timestamps, SAME_TIME)
        if len(rows) < keyframes:
            continue
        poses = rigid.invert(truth.poses[nearest])
        known = RecordedTruth(tuple(frames), poses, np.array(sequence.camera.intrinsics, np.float64))
        window = track_window(
            known, f"{sequence.name}, window {found}", range(keyframes), points, rng, (0, DEPTH_SIGMA)
        )
        if _determined(window):
            found += 1
            yield window


def _determined(window: TrackedWindow) -> bool:
    seen = window.observations
    ends = seen.edges[seen.point_edge].ravel()
    return bool((np.bincount(ends, minlength=len(window.images)) >= MIN_MATCHES).all())


def _nearest(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return values at the nearest pixels, NaN outside."""
    height, width = image.shape
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels > -0.5) & (pixels < np.array([width, height]) - 0.5), axis=1)
    columns, rows = np.rint(pixels[inside]).astype(int).T
    values = np.full(len(pixels), np.nan)
    values[inside] = image[rows, columns]
    return values
