"""Build a straight corridor of equal sections, in which all sections look the same.

Both long walls have the same posters in each section, floor, ceiling and lamps repeat with it, and only the two end
walls differ. It is built to mislead loop closure, and so is not one of `WORLDS`.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.simulation.furniture import RoomBuilder
from vggtgeo.simulation.scene import Scene, finish
from vggtgeo.simulation.sequence import Sensor, SyntheticSequence, camera_of
from vggtgeo.simulation.shapes import Look, Vector
from vggtgeo.simulation.trajectories import HandheldMotion, Walk

SECTION, _WIDTH, _HEIGHT = 2.0, 2.4, 2.5
"""Metres."""
_POSTERS = (0.40, 1.05, 1.65)
"""Places of the posters along a section, metres, three on each side."""
_EYE = 1.4
_PLAIN = Look("plaster", SECTION, detail=0.0)
_RATE, _SPEED = 6.0, 0.4


def repeated_corridor(
    seed: int = 0, sections: int = 6, *, returns: bool = False, size: tuple[int, int] = (320, 240)
) -> SyntheticSequence:
    """Return a walk of RGB-D frames along the corridor, looking at its left wall.

    Args:
        seed: of the posters, the walk and the noise.
        sections: of 2 m each, at least 2.
        returns: whether the camera turns at the end, goes back with a look at the other wall, turns again and ends
            where it began: one real loop, at the end.
        size: (width, height) of the images, pixels.

    Example:
        >>> from repeated_corridor import repeated_corridor
        >>> sequence = repeated_corridor(sections=2, size=(32, 24))
        >>> next(sequence.frames()).image.shape
        (24, 32, 3)

    """
    walk, one_way = _walk(sections)
    motion = HandheldMotion.along(walk, seed)
    way = motion.length + 0.5 if returns else one_way
    frames = int(way / _SPEED * _RATE)
    return SyntheticSequence(_build(seed, sections), motion, camera_of(size), Sensor(), frames, _RATE, seed)


def _walk(sections: int) -> tuple[Walk, float]:
    """Return the closed walk, and metres along it to the end of the corridor."""
    first, last, middle = 0.8, sections * SECTION - 0.8, 0.5 * _WIDTH
    right, left = middle - 0.3, middle + 0.3
    stations = np.linspace(first, last, 2 * sections)
    there = [((x, right, _EYE), (x + 0.1, _WIDTH, _EYE - 0.1)) for x in stations]
    turn = [((last + 0.1, middle, _EYE), (last + 5.0, middle, _EYE - 0.1))]
    back = [((x, left, _EYE), (x - 0.1, 0.0, _EYE - 0.1)) for x in stations[::-1]]
    again = [((first - 0.1, middle, _EYE), (first - 5.0, middle, _EYE - 0.1))]
    way, targets = np.array([*there, *turn, *back, *again]).transpose(1, 0, 2)
    return Walk(way=way, targets=targets, speed=_SPEED, corner=0.15, turn=0.30), last - first


def _build(seed: int, sections: int) -> Scene:
    b = RoomBuilder(seed)
    length = sections * SECTION
    for number in range(sections):
        low, high = (number * SECTION, 0.0), ((number + 1) * SECTION, _WIDTH)
        b.floor_and_ceiling(low, high, _HEIGHT, Look("carpet", None, detail=0.0), Look("ceiling", None, detail=0.0))
        # Walls are listed clockwise seen from above, so that they face inwards.
        _section(b, (low[0], _WIDTH), (high[0], _WIDTH), "a")
        _section(b, (high[0], 0.0), (low[0], 0.0), "b")
        b.lamp_panel(low[0] + 0.5 * SECTION, 0.5 * _WIDTH, _HEIGHT, (0.9, 0.3), power=2.6, reach=6.0)
    for start, end, which in (((0.0, 0.0), (0.0, _WIDTH), 1), ((length, _WIDTH), (length, 0.0), 2)):
        b.wall(start, end, _HEIGHT, _PLAIN)
        b.hang((start, end), 0.5 * _WIDTH, 0.7, (1.4, 1.2), Look(f"painting:{which}", None))
    return finish(b, "repeated corridor", ambient=0.42, exposure=0.72, texel=0.16)


def _section(b: RoomBuilder, start: Vector, end: Vector, side: str) -> None:
    """Add one section of a long wall, with its posters, the same in all sections."""
    b.wall(start, end, _HEIGHT, Look("plaster", None, detail=0.0), edges=False)
    for number, along in enumerate(_POSTERS):
        variant = number + (10 if side == "b" else 0)
        b.hang((start, end), along, 1.0 + 0.12 * number, (0.45, 0.62), Look(f"poster:{variant}", None, detail=0.0))
