"""The map while a run goes on: what each keyframe saw, logged once in its own coordinates, and where the keyframe is.

A cloud under a pose is fused again by logging the pose: where the window moves a keyframe its points follow, at the
price of one transform. So the cost of a frame is bounded: `AT_ONCE` clouds of `MOST_POINTS` points, and a transform for
each keyframe that moved, which are those of the window (all of them where a piece of map is joined).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots, read_at
from vggtgeo.slam.state import Slam

MOST_POINTS = 4000
"""Of a keyframe's cloud: 60 kB, as much as three of the frames' pictures."""
AT_ONCE = 4
"""Clouds logged at a frame: a run that goes on in a known map, or is resumed, has all of its keyframes at once."""
LEAST_CONFIDENCE = 128
"""Of a depth that is shown, of 255: as in the map."""
RADIUS = 0.011
"""Metres."""


@dataclass(frozen=True, eq=False)
class _Logged:
    """What was logged of a keyframe: its frame, pose and slots, by which a change is seen."""

    frame: int
    pose: np.ndarray
    points: Slots


class LiveMap:
    """Logs to `world/live/NUMBER`: the cloud of each keyframe, and the keyframe's camera -> world."""

    def __init__(self, stream: Any):
        self._stream = stream
        self._logged: dict[int, _Logged] = {}

    def update(self, slam: Slam) -> None:
        """Log what is new, and the pose of what moved."""
        room = AT_ONCE
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
        """Take all of it away, and the window's points, from the time on that is set."""
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
    """Whether the cloud of a keyframe is to be logged (again): its points may have been adjusted since, where they are
    what is shown. Those of the window are adjusted with the next keyframe, and shown by `world/points`.
    """
    if before is None or before.frame != keyframe.frame:  # a map may begin again: another frame by the same number
        return True
    return not slam.metric and keyframe.points is not before.points and keyframe.number not in slam.window.members


def own_cloud(keyframe: Keyframe, intrinsics: np.ndarray, *, dense: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points float32 [n, 3] in the keyframe's camera, and colours uint8 [n, 3], at most `MOST_POINTS`.

    dense: of its depth, on a regular grid, where it has any; else of its adjusted points.
    """
    if dense:
        height, width = keyframe.size
        step = int(np.ceil(np.sqrt(height * width / MOST_POINTS)))
        grid = np.s_[step // 2 :: step, step // 2 :: step]
        z = keyframe.depth[grid].astype(np.float64)
        rows, columns = np.nonzero(np.isfinite(z) & (keyframe.depth_confidence[grid] >= LEAST_CONFIDENCE))
        if len(rows):
            pixels = np.column_stack([columns, rows]) * float(step) + step // 2
            points = pinhole.rays(pixels, intrinsics) * z[rows, columns, None]
            return points.astype(np.float32), keyframe.image[grid][rows, columns]
    inverse = keyframe.points.inverse_depth
    known = np.nonzero(np.isfinite(inverse) & (inverse > 0.1))[0][:MOST_POINTS]
    pixels = keyframe.points.pixels[known]
    points = pinhole.rays(pixels, intrinsics) / inverse[known, None]
    return points.astype(np.float32), read_at(keyframe.image, pixels)
