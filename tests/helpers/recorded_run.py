"""Short simulated runs: their settings, frames and states, and all that was seen on the way of one of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from vggtgeo.models.classical import SiftMatcher

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.mapping.cloud import map_points
from vggtgeo.mapping.dense import dense_depths
from vggtgeo.simulation import SyntheticSequence, simulate
from vggtgeo.slam.callback import WindowRecorder
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.run import run_frames
from vggtgeo.slam.settings.groups import GlobalMapSettings, WindowSettings
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam

FRAMES = 9
# One small window shape for the tests of runs, so that the solver is compiled once a process.
SETTINGS = SlamSettings(
    window=WindowSettings(size=4, point_slots=96, line_slots=48),
    refinement=GlobalMapSettings(global_adjustment=False),
)
ROLES = Roles(points=SiftMatcher(count=500))


@cache
def room() -> tuple[list[Frame], Camera, Trajectory]:
    """24 frames of a walk through a room, their camera and the true poses."""
    sequence = simulate("room", 24, 0, (320, 240), rate=10.0)
    return list(sequence.frames()), sequence.camera, sequence.ground_truth()


def run_over(frames: Iterable[Frame], camera: Camera, roles: Roles = ROLES, settings: SlamSettings = SETTINGS) -> Slam:
    """The state after these frames, with its last window adjusted."""
    return merge_pending_window(list(run_frames(iter(frames), camera, roles, settings, Clock()))[-1])


def black(frame: Frame) -> Frame:
    """The frame as it is in the dark: a black image without depth."""
    return replace(frame, image=np.zeros_like(frame.image), depth=np.full(frame.image.shape[:2], np.nan, np.float32))


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """The states after each frame, the frames, and what a recorder noted."""

    sequence: SyntheticSequence
    frames: list[Frame]
    states: list[Slam]
    recorder: WindowRecorder
    cloud: PointCloud

    @property
    def slam(self) -> Slam:
        return self.states[-1]


@cache
def walk() -> SyntheticSequence:
    """What the run is of."""
    return simulate("room", FRAMES, 0, (320, 240), rate=10.0)


@cache
def recorded_run() -> RecordedRun:
    """The run, made once a process."""
    sequence = walk()
    frames, states, recorder = list(sequence.frames()), [], WindowRecorder()
    for slam in run_frames(iter(frames), sequence.camera, ROLES, SETTINGS, Clock()):
        recorder.on_frame(slam, frames[slam.frames[-1].frame])
        states.append(slam)
    states[-1] = merge_pending_window(states[-1])
    recorder.on_adjust(states[-1])
    return RecordedRun(
        sequence,
        frames,
        states,
        recorder,
        map_points(slam.keyframes, slam.intrinsics, dense_depths(slam.keyframes, slam.intrinsics)),
    )
