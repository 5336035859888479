"""Run a section of a clip in this process: shared by the benchmarks of the map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.run import default_roles, run_frames
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam

SETTINGS = SlamSettings()


@dataclass(frozen=True, eq=False)
class Piece:
    """A section of a clip, its camera, the roles for it, and the true pose of each frame, camera -> world."""

    name: str
    frames: list[Frame]
    camera: Camera
    roles: Roles
    truth: Trajectory

    @classmethod
    def of(cls, path: Path, count: int, depth: bool = True) -> Piece:
        """Read the first `count` frames, with the true pose nearest in time to each. depth: use measured depth."""
        jax.config.update("jax_enable_x64", True)
        sequence = open_sequence(path)
        frames = [frame if depth else replace(frame, depth=None) for frame in sequence.frames(0, count, 1)]
        truth = sequence.ground_truth()
        rows = [int(np.argmin(np.abs(truth.timestamps - frame.timestamp))) for frame in frames]
        times = np.array([frame.timestamp for frame in frames])
        roles = default_roles(sequence.has_depth and depth)
        return cls(path.name, frames, sequence.camera, roles, Trajectory(times, truth.poses[rows]))

    def run(self, seed: int = 0) -> Slam:
        """Return the state after the last frame, before the last adjustment."""
        roles = self.roles.seeded(seed)
        return list(run_frames(iter(self.frames), self.camera, roles, SETTINGS, Clock()))[-1]
