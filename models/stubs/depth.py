"""Simulated MoGe-2: the true depth with a smooth relative error and a scale that wobbles from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from vggtgeo.models.roles import DepthEstimate
from vggtgeo.models.stubs.oracle import Oracle
from vggtgeo.models.stubs.random_fields import SmoothField, check_settings, stream, weakness


@dataclass(frozen=True)
class SimulatedMoge:
    """Error model: log depth = log truth + sigma(u) f(u, t) + wobble g, f a smooth field, g normal, one a frame.

    sigma(u) = error (1 + weak w(u)), with w in [0, 1] the lack of texture, and `glass` times that behind glass.
    error: relative deviation where texture is good. weak: how much larger it is without texture. cycles: waves of the
    error across the picture. memory: seconds over which the error of neighbouring frames stays alike. wobble: relative
    deviation of a frame's scale. The estimate states sqrt(sigma^2 + wobble^2) and a confidence error / sigma(u).
    """

    simulated: ClassVar[bool] = True

    oracle: Oracle
    seed: int = 0
    error: float = 0.05
    weak: float = 0.6
    glass: float = 3.0
    cycles: float = 1.2
    memory: float = 1.0
    wobble: float = 0.02

    def __post_init__(self) -> None:
        check_settings(self, error=0, weak=0, glass=1, cycles=0, memory=1e-3, wobble=0)

    def estimate(
        self, image: np.ndarray, sensor_depth: np.ndarray | None = None, intrinsics: Sequence[float] | None = None
    ) -> DepthEstimate:
        """Simulated depth of `image`; the sensor's depth is not looked at."""
        index = self.oracle.index_of(image)
        depth = self.oracle.depth(index)
        sigma = self.error * (1 + self.weak * weakness(self.oracle, index))
        sigma = sigma * np.where(self.oracle.glass(index), self.glass, 1.0)
        field = SmoothField(self.seed, "moge", self.cycles, self.memory)
        scale = self.wobble * stream(self.seed, "moge", index).standard_normal()
        log_error = sigma * field.sample(depth.shape, self.oracle.timestamp(index)) + scale
        confidence = np.where(np.isfinite(depth), self.error / np.maximum(sigma, 1e-12), 0.0)
        stated = np.where(np.isfinite(depth), np.maximum(np.hypot(sigma, self.wobble), 1e-6), np.nan)
        return DepthEstimate(
            (depth * np.exp(log_error)).astype(np.float32), confidence.astype(np.float32), stated.astype(np.float32)
        )
