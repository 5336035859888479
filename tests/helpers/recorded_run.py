"""A short simulated run for the tests of what is drawn: its last state, its map, and all that was seen on the way."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

from vggtgeo.models.classical import SiftMatcher

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.mapping.cloud import map_points
from vggtgeo.mapping.dense import dense_depths
from vggtgeo.simulation import SyntheticSequence, simulate
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.pending_window import merge_pending_window
from vggtgeo.slam.run import run_frames
from vggtgeo.slam.settings.groups import GlobalMapSettings, WindowSettings
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window_recorder import WindowRecorder

FRAMES = 9
# The shape of tests/slam/test_pipeline.py, so that a process that runs both compiles the solver once.
SETTINGS = SlamSettings(
    window=WindowSettings(size=4, point_slots=96, line_slots=48),
    refinement=GlobalMapSettings(global_adjustment=False),
)
ROLES = Roles(points=SiftMatcher(count=500))


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
