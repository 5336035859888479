"""The walks that the tables are measured on."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vggtgeo.io.errors import InputError
from vggtgeo.simulation import WORLDS


@dataclass(frozen=True)
class Course:
    """A walk through a built-in world, and how densely it is looked at.

    frames: number of frames. rate: frames a second. size: (width, height), pixels. key_points: of the simulated
    matcher, a frame. keyframe_distance: metres, keyframe_angle: degrees between keyframes.
    Raises InputError for an unknown scene or a number that is not positive.
    """

    scene: str
    frames: int
    rate: float
    size: tuple[int, int] = (320, 240)
    key_points: int = 800
    keyframe_distance: float = 0.15
    keyframe_angle: float = 5.0

    def __post_init__(self) -> None:
        if self.scene not in WORLDS:
            raise InputError(f"`scene` is {self.scene!r}; it must be one of {', '.join(WORLDS)}")
        for name in ("frames", "rate", "key_points", "keyframe_distance", "keyframe_angle"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"`{name}` is {value}; it must be positive")

    @property
    def text(self) -> str:
        """The course in words, for the head of a table."""
        width, height = self.size
        return (
            f"{self.scene}: {self.frames} frames of {width} x {height} at {self.rate:g}/s, {self.key_points} points "
            f"a frame, a keyframe every {self.keyframe_distance:g} m or {self.keyframe_angle:g} deg"
        )
