"""The one value that the pipeline folds over frames."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np

from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.tracking.tracker import FramePose, Tracker, frame_pose
from vggtgeo.slam.window.window import Window


@dataclass(frozen=True, eq=False)
class PendingWindow:
    """An adjustment of the window that goes on beside tracking, see `pending_window.py`.

    due: number of frames from which on the state has its result. begun: the state that it began with. result: that
    state, adjusted.
    """

    due: int
    begun: Slam
    result: Future[Slam]

    def __reduce__(self) -> tuple[Callable[..., PendingWindow], tuple[int, Slam, Slam]]:
        """So that states pickle, and copy: with the result, which is waited for."""
        return _done, (self.due, self.begun, self.result.result())


def _done(due: int, begun: Slam, result: Slam) -> PendingWindow:
    future: Future[Slam] = Future()
    future.set_result(result)
    return PendingWindow(due, begun, future)


@dataclass(frozen=True, eq=False)
class Slam:
    """Everything known after some frames: four values, one a stage, that know nothing of each other.

    Fields:
        map: Keyframes, their matches and factors.
        camera: Estimate of the intrinsics.
        tracker: The pose of every frame, and the motion of the camera.
        window: The keyframes that are adjusted together.
        pending: The adjustment of the newest keyframe's window, while it goes on.
        notes: What the user should know.

    """

    map: Map
    camera: CameraEstimate
    tracker: Tracker = field(default_factory=Tracker)
    window: Window = field(default_factory=Window)
    pending: PendingWindow | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        frames, keyframes = len(self.frames), len(self.keyframes)
        doing = "lost" if self.tracker.lost else "waiting for parallax" if self.tracker.waiting else "tracking"
        return f"Slam({frames} frame{'s' * (frames != 1)}, {keyframes} keyframe{'s' * (keyframes != 1)}, {doing})"

    @property
    def metric(self) -> bool:
        """Whether lengths are metres."""
        return self.map.metric

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """The keyframes of the map, by number."""
        return self.map.keyframes

    @property
    def adjusted_keyframes(self) -> tuple[Keyframe, ...]:
        """All but the newest, where that one's window is still being adjusted."""
        return self.keyframes if self.pending is None else self.keyframes[:-1]

    @property
    def intrinsics(self) -> np.ndarray:
        """Current fx, fy, cx, cy, float64 [4], pixels."""
        return self.camera.intrinsics

    @property
    def frames(self) -> tuple[FramePose, ...]:
        """Every frame's pose relative to its keyframe."""
        return self.tracker.frames

    def pose(self, record: FramePose) -> np.ndarray:
        """World -> camera of a frame, float64 [4, 4], by the current estimate of its keyframe."""
        return frame_pose(self.map, record)

    @property
    def last_pose(self) -> np.ndarray:
        """World -> camera of the last frame."""
        return self.pose(self.frames[-1]) if self.frames else np.eye(4)
