"""Log a run to Rerun: the camera of each frame, the window of each keyframe, the iterations of its solver."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.bundle.analysis.covariances import covariances
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import InputWarning
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.settings.groups import WindowSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window_recorder import WindowRecorder
from vggtgeo.viewing import entities
from vggtgeo.viewing.live_map import LiveMap
from vggtgeo.viewing.target import flush


class RerunCallback(Callback):
    """Logs to `stream`, with the timelines `frame`, `time` (s) and `iteration` (tried steps of all windows' solvers).

    window: keyframes of a window; pairs farther apart are loop closures. file: file of the stream, if any. cut_short:
    whether the recording is incomplete, which is a warning and does not stop the run.
    """

    def __init__(self, stream: Any, window: int = WindowSettings().size, file: Path | None = None):
        import rerun as rr

        self.stream, self._file, self.cut_short = stream, file, False
        self._recorder = WindowRecorder()
        self._window, self._live = window, LiveMap(stream)
        self._keyframes = self._notes = self._iterations = 0
        self._was_lost = False
        stream.log("world", rr.ViewCoordinates.RDF, static=True)

    @in_double_precision
    def on_warm_up(self, problem: Problem, state: State) -> None:
        """Compile for windows of the shape of `problem`."""
        self._recorder.on_warm_up(problem, state)
        covariances(problem, state).poses.block_until_ready()

    @in_double_precision
    def on_frame(self, slam: Slam, frame: Frame) -> None:
        self.stream.set_time("frame", sequence=frame.index)
        self.stream.set_time("time", duration=frame.timestamp)
        entities.log_camera(self.stream, slam.last_pose, slam.intrinsics, frame.image)
        entities.log_tracking(self.stream, slam)
        if bool(slam.tracker.lost) != self._was_lost:
            self._was_lost = bool(slam.tracker.lost)
            entities.log_lost(self.stream, slam)
        for note in slam.notes[self._notes :]:
            entities.log_note(self.stream, note)
        self._notes = len(slam.notes)
        self._log_adjusted(slam)

    def on_adjust(self, slam: Slam) -> None:
        self._log_adjusted(slam)

    def on_finish(self, slam: Slam, cloud: PointCloud) -> None:
        """Log the path after the last adjustment, and replace the live map by the dense map."""
        self._log_path(slam)
        self._live.clear()
        entities.log_map(self.stream, cloud)
        counts = f"{len(slam.frames)} frames, {len(slam.keyframes)} keyframes, {len(cloud)} points in the map"
        entities.log_note(self.stream, f"finished: {counts}", level="INFO")
        if problem := flush(self.stream, self._file):
            self.cut_short = self._file is not None
            warnings.warn(problem, InputWarning, stacklevel=2)

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
        entities.log_keyframe(self.stream, members[-1], max(matched, key=lambda pair: pair.first, default=None))
        entities.log_window(self.stream, members, list(slam.map.pairs))
        self._log_path(slam)
        entities.log_points(self.stream, members, slam.intrinsics)
        if slam.window.solved is None or not self._recorder.records:
            return
        adjustment, state = slam.window.solved
        found = np.asarray(covariances(adjustment.problem, state).poses)[: len(members)]
        entities.log_covariance(self.stream, members, found)
        entities.log_residuals(self.stream, self._recorder.records[-1])
        self._log_iterations(slam)

    def _log_path(self, slam: Slam) -> None:
        entities.log_path(self.stream, frame_trajectory(slam), keyframe_trajectory(slam))
        entities.log_loops(self.stream, slam, self._window)
        entities.log_lost(self.stream, slam)

    def _log_iterations(self, slam: Slam) -> None:
        if slam.window.energies is None:
            return
        for row, energy in enumerate(slam.window.energies):
            self.stream.set_time("iteration", sequence=self._iterations)
            entities.log_iteration(self.stream, row, float(energy), slam.window.iterations, len(slam.window.members))
            self._iterations += 1
