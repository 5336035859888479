"""Ground-truth surfaces from exact depth images and poses, of rendered sequences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from vggtgeo.datasets.frame import Sequence
from vggtgeo.evaluation import nearest_in_time
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

_DELAY = 0.005
"""Largest time between a frame and its true pose, seconds: rendered ones are simultaneous."""


@runtime_checkable
class ExactFrames(Protocol):
    """Exact depth and poses by the frame's index in the sequence."""

    @property
    def camera(self) -> Camera:
        """Pinhole camera."""
        ...

    def __len__(self) -> int: ...

    def depth(self, index: int) -> np.ndarray:
        """True depth float64 [H, W], metres, NaN = unknown."""
        ...

    def pose(self, index: int) -> np.ndarray:
        """True pose, world -> camera, float64 [4, 4]; NaN if unknown."""
        ...


@dataclass(frozen=True, eq=False)
class RecordedFrames:
    """Exact frames of a recording whose depth files are exact."""

    sequence: Sequence
    truth: Trajectory

    @classmethod
    def of(cls, sequence: Sequence) -> RecordedFrames | None:
        """Return the frames; None without depth or ground truth. InputError for a distorted camera: maps are of
        undistorted images.
        """
        truth = sequence.ground_truth()
        if truth is None or not sequence.has_depth:
            return None
        if sequence.camera.distorts:
            raise InputError(f"`exact_depth` is for undistorted images, `{sequence.name}` is distorted; leave it out")
        return cls(sequence, truth)

    @property
    def camera(self) -> Camera:
        """Camera of the recording."""
        return self.sequence.camera

    def __len__(self) -> int:
        return len(self.sequence)

    def depth(self, index: int) -> np.ndarray:
        """Depth of the file; all NaN if it cannot be read."""
        frame = next(self.sequence.frames(index, index + 1), None)
        if frame is None or frame.depth is None:
            return np.full((self.camera.height, self.camera.width), np.nan)
        return frame.depth.astype(np.float64)

    def pose(self, index: int) -> np.ndarray:
        """Ground truth at the time of the frame."""
        frame = next(self.sequence.frames(index, index + 1), None)
        times = np.array([] if frame is None else [frame.timestamp])
        _, rows = nearest_in_time(times, self.truth.timestamps, _DELAY)
        return rigid.invert(self.truth.poses[rows])[0] if len(rows) else np.full((4, 4), np.nan)


def exact_cloud(frames: ExactFrames, max_frames: int = 30, step: int = 4) -> np.ndarray:
    """Return world points of the visible surfaces, float64 [n, 3]: every `step`-th pixel of `max_frames` frames."""
    fx, fy, cx, cy = frames.camera.intrinsics
    count = len(frames)
    clouds = []
    for index in np.unique(np.linspace(0, count - 1, min(count, max_frames)).round().astype(int)):
        depth, pose = frames.depth(int(index))[::step, ::step], frames.pose(int(index))
        v, u = np.nonzero(np.isfinite(depth) & np.isfinite(pose).all())
        z = depth[v, u]
        local = np.column_stack([(step * u - cx) / fx * z, (step * v - cy) / fy * z, z])
        clouds.append((local - pose[:3, 3]) @ pose[:3, :3])
    return np.concatenate(clouds)
