"""The state of the pipeline, folded over the frames; its submaps, and its stretches of frames without a pose."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.sparse_map.factors import Factor
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import Map, submap_of
from vggtgeo.slam.tracking.tracking_state import FramePose, Tracker, frame_pose
from vggtgeo.slam.window.sliding_window import Window


@dataclass(frozen=True, eq=False)
class PendingWindow:
    """An adjustment of the window that runs beside tracking, see `local_mapping.py`.

    due: number of frames at which the state takes its result. begun: the state that it started from. result: that
    state, adjusted.
    """

    due: int
    begun: Slam
    result: Future[Slam]

    def __reduce__(self) -> tuple[Callable[..., PendingWindow], tuple[int, Slam, Slam]]:
        """Wait for the result, so that states can be pickled and copied."""
        return _done, (self.due, self.begun, self.result.result())


def _done(due: int, begun: Slam, result: Slam) -> PendingWindow:
    future: Future[Slam] = Future()
    future.set_result(result)
    return PendingWindow(due, begun, future)


@dataclass(frozen=True, eq=False)
class Slam:
    """The state after some frames: four independent values, one a stage.

    Fields:
        map: Keyframes, their matches and factors.
        camera: Estimate of the intrinsics.
        tracker: The pose of every frame, and the motion of the camera.
        window: The keyframes that are adjusted together.
        pending: The running adjustment of the newest keyframe's window.
        notes: Notes for the user.

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
        """All keyframes but the newest if its window is still being adjusted."""
        return self.keyframes if self.pending is None else self.keyframes[:-1]

    @property
    def intrinsics(self) -> np.ndarray:
        """Current fx, fy, cx, cy, float64 [4], pixels."""
        return self.camera.intrinsics

    @property
    def frames(self) -> tuple[FramePose, ...]:
        """Every frame's pose relative to its keyframe."""
        return self.tracker.frames

    def with_map(self, **fields: Any) -> Slam:
        """Return the state with these fields of its map replaced."""
        return replace(self, map=replace(self.map, **fields))

    def with_tracker(self, **fields: Any) -> Slam:
        """Return the state with these fields of its tracker replaced."""
        return replace(self, tracker=replace(self.tracker, **fields))

    def with_window(self, **fields: Any) -> Slam:
        """Return the state with these fields of its window replaced."""
        return replace(self, window=replace(self.window, **fields))

    def with_camera(self, **fields: Any) -> Slam:
        """Return the state with these fields of the estimate of its camera replaced."""
        return replace(self, camera=replace(self.camera, **fields))

    def with_factors(self, *factors: Factor) -> Slam:
        """Return the state with further factors in its map."""
        return self.with_map(factors=(*self.map.factors, *factors))

    def with_notes(self, *notes: str) -> Slam:
        """Return the state with those of the notes that it does not have yet."""
        return replace(self, notes=(*self.notes, *(note for note in notes if note not in self.notes)))

    def pose(self, record: FramePose) -> np.ndarray:
        """Return world -> camera of a frame, float64 [4, 4], by the current estimate of its keyframe."""
        return frame_pose(self.map, record)

    @property
    def last_pose(self) -> np.ndarray:
        """World -> camera of the last frame."""
        return self.pose(self.frames[-1]) if self.frames else np.eye(4)


def submaps_by_size(slam: Slam) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of the keyframes of each submap, first of the one with the most frames."""
    if not slam.keyframes:
        return ()
    label = submap_of(slam.map)
    hanging = np.bincount(label[[r.reference for r in slam.frames if r.tracked]], minlength=label.max(initial=-1) + 1)
    order = np.argsort(-hanging, kind="stable")
    return tuple(tuple(int(number) for number in np.nonzero(label == submap)[0]) for submap in order)


def lost_stretches(slam: Slam) -> tuple[tuple[int, int], ...]:
    """Return the first and last row of `slam.frames` of each stretch of frames without a pose."""
    return stretches(np.array([not record.tracked for record in slam.frames], bool))


def stretches(marked: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Return the first and last row of each run of True values of bool [n]."""
    first, past = np.flatnonzero(np.diff(np.r_[False, marked, False])).reshape(-1, 2).T
    return tuple((int(i), int(j) - 1) for i, j in zip(first, past, strict=True))
