"""Log a run to Rerun: the camera of each frame, the window of each keyframe, its solver's iterations, and the map.

The map consists of the cloud of each keyframe, logged once in the keyframe's own frame, and of the keyframe's pose.
When an adjustment changes the pose, only the pose is logged again. So the cost per frame is bounded: at most
`MAX_CLOUDS` clouds of `MAX_POINTS` points, and one transform for each changed keyframe: those of the window, or all
when submaps are merged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.bundle.analysis.covariances import covariances
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import pinhole
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import warn
from vggtgeo.slam.callback import Callback, WindowRecorder
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.settings.groups import WindowSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.state import Slam
from vggtgeo.viewing.entities import Entities
from vggtgeo.viewing.target import flush

MAX_POINTS = 4000
"""Maximum points of a keyframe's cloud: 60 kB, as much as the images of three frames."""
MAX_CLOUDS = 4
"""Maximum clouds logged per frame: a run in a known map, or a resumed run, starts with many keyframes."""
MIN_CONFIDENCE = 128
"""Minimum confidence of depth that is shown, of 255; the map has the same limit."""


@dataclass(frozen=True, eq=False)
class _Logged:
    """Frame, pose and points of a keyframe as logged, to detect changes."""

    frame: int
    pose: np.ndarray
    points: Slots


class LiveMap:
    """Logs the cloud of each keyframe and its pose, camera -> world, to `world/live/NUMBER`."""

    def __init__(self, entities: Entities) -> None:
        self._entities = entities
        self._logged: dict[int, _Logged] = {}

    def update(self, slam: Slam) -> None:
        """Log new clouds, and the poses of moved keyframes."""
        remaining = MAX_CLOUDS
        for keyframe in slam.adjusted_keyframes:
            before = self._logged.get(keyframe.number)
            if remaining and _is_stale(keyframe, before, slam):
                points, colours = keyframe_cloud(keyframe, slam.intrinsics, dense=slam.metric)
                self._entities.cloud(f"world/live/{keyframe.number}", points, colours)
                remaining -= 1
                self._entities.pose(f"world/live/{keyframe.number}", keyframe.pose)
                self._logged[keyframe.number] = _Logged(keyframe.frame, keyframe.pose, keyframe.points)
            elif before is not None and keyframe.pose is not before.pose:
                self._entities.pose(f"world/live/{keyframe.number}", keyframe.pose)
                self._logged[keyframe.number] = replace(before, pose=keyframe.pose)

    def clear(self) -> None:
        """Remove the clouds and the window's points, from the current time on."""
        self._entities.clear("world/live", "world/points")
        self._logged.clear()


def _is_stale(keyframe: Keyframe, before: _Logged | None, slam: Slam) -> bool:
    """Return whether the cloud of a keyframe is new or has changed since it was logged.

    Without dense depth the cloud consists of the adjusted points, which may have changed. Those of the window change
    with each keyframe and are shown by `world/points` instead.
    """
    if before is None or before.frame != keyframe.frame:  # a new map reuses keyframe numbers
        return True
    return not slam.metric and keyframe.points is not before.points and keyframe.number not in slam.window.members


def keyframe_cloud(keyframe: Keyframe, intrinsics: np.ndarray, *, dense: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return points float32 [n, 3] in the keyframe's camera frame, and colours uint8 [n, 3]; at most `MAX_POINTS`.

    dense: use its depth on a regular grid, if it has depth; else its adjusted points.
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
    return points.astype(np.float32), pinhole.at_pixels(keyframe.image, pixels)


class RerunCallback(Callback):
    """Logs to `stream`, with the timelines `frame`, `time` (s) and `iteration` (steps tried by the solver, in total).

    window: number of keyframes of a window; pairs farther apart are loop closures. file: file of the stream, if any.
    incomplete: whether a part of the recording could not be written, which is a warning and does not stop the run.
    """

    def __init__(self, stream: Any, window: int = WindowSettings().size, file: Path | None = None):
        self.stream, self._file, self.incomplete = stream, file, False
        self._entities, self._recorder = Entities(stream), WindowRecorder()
        self._window, self._live = window, LiveMap(self._entities)
        self._keyframes = self._notes = self._iterations = 0
        self._was_lost = False
        self._entities.axes()

    @in_double_precision
    def on_warm_up(self, problem: Problem, state: State) -> None:
        """Compile for windows of the shape of `problem`."""
        self._recorder.on_warm_up(problem, state)
        covariances(problem, state).poses.block_until_ready()

    @in_double_precision
    def on_frame(self, slam: Slam, frame: Frame) -> None:
        self.stream.set_time("frame", sequence=frame.index)
        self.stream.set_time("time", duration=frame.timestamp)
        self._entities.camera(slam.last_pose, slam.intrinsics, frame.image)
        self._entities.tracking(slam)
        if bool(slam.tracker.lost) != self._was_lost:
            self._was_lost = bool(slam.tracker.lost)
            self._entities.lost(slam)
        for note in slam.notes[self._notes :]:
            self._entities.note(note)
        self._notes = len(slam.notes)
        self._log_adjusted(slam)

    def on_adjust(self, slam: Slam) -> None:
        self._log_adjusted(slam)

    def on_finish(self, slam: Slam, cloud: PointCloud) -> None:
        """Log the path after the last adjustment, and replace the live map by the dense map."""
        self._log_path(slam)
        self._live.clear()
        self._entities.cloud("world/map", cloud.points, cloud.colours)
        counts = f"{len(slam.frames)} frames, {len(slam.keyframes)} keyframes, {len(cloud)} points in the map"
        self._entities.note(f"finished: {counts}", level="INFO")
        if problem := flush(self.stream, self._file):
            self.incomplete = self._file is not None
            warn(problem)

    @in_double_precision
    def _log_adjusted(self, slam: Slam) -> None:
        """Log new keyframes, once their window is adjusted."""
        self._live.update(slam)
        self._recorder.on_adjust(slam)
        if len(slam.adjusted_keyframes) > self._keyframes:
            self._keyframes = len(slam.adjusted_keyframes)
            self._log_new_keyframe(slam)

    def _log_new_keyframe(self, slam: Slam) -> None:
        numbers = slam.window.members if slam.window.solved is None else slam.window.solved[0].keyframes
        members = [slam.keyframes[number] for number in numbers]
        newest = members[-1].number
        matched = [pair for pair in slam.map.pairs if pair.second == newest]
        self._entities.keyframe(members[-1], max(matched, key=lambda pair: pair.first, default=None))
        self._entities.window(members, list(slam.map.pairs))
        self._log_path(slam)
        self._entities.points(members, slam.intrinsics)
        if slam.window.solved is None or not self._recorder.records:
            return
        adjustment, state = slam.window.solved
        found = np.asarray(covariances(adjustment.problem, state).poses)[: len(members)]
        self._entities.covariance(members, found)
        self._entities.residuals(self._recorder.records[-1])
        self._log_iterations(slam)

    def _log_path(self, slam: Slam) -> None:
        self._entities.path(frame_trajectory(slam), keyframe_trajectory(slam))
        self._entities.loops(slam, self._window)
        self._entities.lost(slam)

    def _log_iterations(self, slam: Slam) -> None:
        if slam.window.energies is None:
            return
        for row, energy in enumerate(slam.window.energies):
            self.stream.set_time("iteration", sequence=self._iterations)
            self._entities.iteration(row, float(energy), slam.window.iterations, len(slam.window.members))
            self._iterations += 1
