"""One synthetic room for all tests: it takes seconds to build, and nothing ever changes it."""

from dataclasses import replace
from functools import cache

from vggtgeo.simulation import Sensor, SyntheticSequence, simulate
from vggtgeo.simulation.sequence import camera_of

SEED = 1


@cache
def _room() -> SyntheticSequence:
    return simulate("room", seed=SEED)


def room(frames: int, size: tuple[int, int], rate: float = 30.0, sensor: Sensor | None = None) -> SyntheticSequence:
    """The walk through the room with seed 1 as `simulate` would give it."""
    return replace(_room(), count=frames, camera=camera_of(size), rate=rate, sensor=sensor or Sensor())
