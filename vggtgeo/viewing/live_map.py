"""The map during a run: the cloud of each keyframe, logged once in its own frame, and the keyframe's pose.

When an adjustment moves a keyframe, logging its pose moves its points as well. So the cost per frame is bounded: at
most `MAX_CLOUDS` clouds of `MAX_POINTS` points, and a transform per moved keyframe: those of the window, or all of them
when submaps are merged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots, read_at
from vggtgeo.slam.state import Slam

MAX_POINTS = 4000
"""Of a keyframe's cloud: 60 kB, as much as three of the frames' images."""
MAX_CLOUDS = 4
"""Clouds logged per frame: a run in a known map, or a resumed one, starts with many keyframes."""
MIN_CONFIDENCE = 128
"""Of depth that is shown, of 255: as in the map."""
RADIUS = 0.011
"""Metres."""


@dataclass(frozen=True, eq=False)
class _Logged:
    """Frame, pose and points of a keyframe as logged, to detect changes."""

    frame: int
    pose: np.ndarray
    points: Slots


class LiveMap:
    """Logs the cloud of each keyframe and its pose, camera -> world, to `world/live/NUMBER`."""

    def __init__(self, stream: Any):
        self._stream = stream
        self._logged: dict[int, _Logged] = {}

    def update(self, slam: Slam) -> None:
        """Log new clouds, and the poses of moved keyframes."""
        room = MAX_CLOUDS
        for keyframe in slam.adjusted_keyframes:
            before = self._logged.get(keyframe.number)
            if room and _is_stale(keyframe, before, slam):
                self._log_cloud(keyframe, slam)
                room -= 1
                self._log_pose(keyframe)
                self._logged[keyframe.number] = _Logged(keyframe.frame, keyframe.pose, keyframe.points)
            elif before is not None and keyframe.pose is not before.pose:
                self._log_pose(keyframe)
                self._logged[keyframe.number] = replace(before, pose=keyframe.pose)

    def clear(self) -> None:
        """Remove the clouds and the window's points, from the current time on."""
        import rerun as rr

        for path in ("world/live", "world/points"):
            self._stream.log(path, rr.Clear(recursive=True))
        self._logged.clear()

    def _log_cloud(self, keyframe: Keyframe, slam: Slam) -> None:
        import rerun as rr

        points, colours = own_cloud(keyframe, slam.intrinsics, dense=slam.metric)
        self._stream.log(f"world/live/{keyframe.number}", rr.Points3D(points, colors=colours, radii=RADIUS))

    def _log_pose(self, keyframe: Keyframe) -> None:
        import rerun as rr

        to_world = rigid.invert(keyframe.pose)
        transform = rr.Transform3D(translation=to_world[:3, 3], mat3x3=to_world[:3, :3])
        self._stream.log(f"world/live/{keyframe.number}", transform)


def _is_stale(keyframe: Keyframe, before: _Logged | None, slam: Slam) -> bool:
    """Return whether to log the cloud of a keyframe (again).

    Without dense depth the cloud is that of the adjusted points, which may have changed. Those of the window change
    with each keyframe and are shown by `world/points`.
    """
    if before is None or before.frame != keyframe.frame:  # a new map reuses keyframe numbers
        return True
    return not slam.metric and keyframe.points is not before.points and keyframe.number not in slam.window.members


def own_cloud(keyframe: Keyframe, intrinsics: np.ndarray, *, dense: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return points float32 [n, 3] in the keyframe's camera frame, and colours uint8 [n, 3]; at most `MAX_POINTS`.

    dense: use its depth on a regular grid, if it has any; else its adjusted points.
    """
    if dense:
        height, width = keyframe.size
        step = int(np.ceil(np.sqrt(height * width / MAX_POINTS)))
        grid = np.s_[step // 2 :: step, step // 2 :: step]
        z = keyframe.depth[grid].astype(np.float64)
        rows, columns = np.nonzero(np.isfinite(z) & (keyframe.depth_confidence[grid] >= MIN_CONFIDENCE))
        if len(rows):
            pixels = np.column_stack([columns, rows]) * float(step) + step // 2
            points = pinhole.rays(pixels, intrinsics) * z[rows, columns, None]
            return points.astype(np.float32), keyframe.image[grid][rows, columns]
    inverse = keyframe.points.inverse_depth
    known = np.nonzero(np.isfinite(inverse) & (inverse > 0.1))[0][:MAX_POINTS]
    pixels = keyframe.points.pixels[known]
    points = pinhole.rays(pixels, intrinsics) / inverse[known, None]
    return points.astype(np.float32), read_at(keyframe.image, pixels)
