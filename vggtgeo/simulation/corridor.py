"""The `corridor`: an L of 38 + 20 m, 2.2 m wide, with bare white walls, equal doors and panes of glass.

Built to be hard: hardly any texture, the same door every 3.2 m, mirrors in glass, blank ends to turn before.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.simulation.furniture import DARK, METAL, WHITE, Place, RoomBuilder
from vggtgeo.simulation.scene import Scene, finish
from vggtgeo.simulation.shapes import Look, Vector
from vggtgeo.simulation.trajectories import Walk

_LONG, _SHORT, _WIDTH, _HEIGHT = 38.0, 20.0, 2.2, 2.6
_FLOOR = Look("white", 1.6, tint=(0.36, 0.38, 0.40), detail=0.05)
_GREY = Look("white", 1.0, tint=(0.30, 0.31, 0.33), detail=0.03)
_MEETING_ROOMS = (9.6, 22.4)  # metres along the south wall where a pane of 3 m replaces the wall
_PANE = 3.0

CORRIDOR_WALK = Walk(
    way=np.array(
        [
            [1.6, 0.90, 1.60],
            [12.0, 0.85, 1.60],
            [24.0, 0.95, 1.55],
            [36.6, 0.90, 1.60],
            [37.1, 9.0, 1.60],
            [37.1, 18.4, 1.55],
            [36.6, 18.4, 1.55],
            [36.5, 9.0, 1.60],
            [36.3, 1.35, 1.60],
            [24.0, 1.35, 1.60],
            [12.0, 1.30, 1.55],
            [1.6, 1.35, 1.60],
        ]
    ),
    speed=1.0,
    corner=0.25,
    turn=0.55,
    glance=0.22,
    pitch=-0.06,
)


def build_corridor(seed: int) -> Scene:
    """Build two arms with doors on both sides, two meeting rooms behind glass, and a few things to hold on to."""
    b = RoomBuilder(seed)
    b.floor_and_ceiling((0, 0), (_LONG, _WIDTH), _HEIGHT, _FLOOR, Look("ceiling", 1.2, detail=0.03))
    low, high = (_LONG - _WIDTH, _WIDTH), (_LONG, _SHORT)
    b.floor_and_ceiling(low, high, _HEIGHT, _FLOOR, Look("ceiling", 1.2, detail=0.03))
    inner = _LONG - _WIDTH
    _plain_wall(b, (0, 0), (0, _WIDTH), False)
    _plain_wall(b, (0, _WIDTH), (inner, _WIDTH))
    _plain_wall(b, (inner, _WIDTH), (inner, _SHORT))
    _plain_wall(b, (inner, _SHORT), (_LONG, _SHORT), False)
    _plain_wall(b, (_LONG, _SHORT), (_LONG, 0))
    end = _LONG
    for start in sorted(_MEETING_ROOMS, reverse=True):
        _plain_wall(b, (end, 0), (start + _PANE, 0))
        _meeting_room(b, start)
        end = start
    _plain_wall(b, (end, 0), (0, 0))
    _landmarks(b)
    for x in np.arange(1.6, _LONG, 3.2):
        b.lamp_panel(float(x), 0.5 * _WIDTH, _HEIGHT, (1.2, 0.3), power=2.6, reach=6.0)
    for y in np.arange(_WIDTH + 1.6, _SHORT, 3.2):
        b.lamp_panel(_LONG - 0.5 * _WIDTH, float(y), _HEIGHT, (0.3, 1.2), power=2.6, reach=6.0)
    return finish(b, "corridor", ambient=0.42, exposure=0.72, texel=0.16)


def _plain_wall(b: RoomBuilder, start: Vector, end: Vector, doors: bool = True) -> None:
    """Add white paint, a skirting, and the same grey door with its sign every 3.2 m."""
    b.wall(start, end, _HEIGHT, WHITE, edges=True)
    length = b.skirting(start, end, 0.10, 0.012, _GREY)
    if not doors:
        return
    for along in np.arange(1.6, length - 0.7, 3.2):
        b.hang(start, end, float(along), 0.0, (1.02, 2.10), _GREY, 0.03, _GREY)
        leaf = Look("white", 1.0, tint=(0.55, 0.58, 0.60), detail=0.02)
        b.hang(start, end, float(along), 0.01, (0.90, 2.03), leaf, 0.045, _GREY)
        b.hang(start, end, float(along) + 0.36, 1.02, (0.14, 0.03), METAL, 0.09, METAL)
        b.hang(start, end, float(along) + 0.72, 1.50, (0.16, 0.12), Look("sign:1", None), 0.015)


def _meeting_room(b: RoomBuilder, start: float) -> None:
    """Add a dim room of 3 x 3 m south of the corridor behind one pane of glass in a frame."""
    low, high = (start, -3.0), (start + _PANE, 0.0)
    b.floor_and_ceiling(low, high, _HEIGHT, Look("carpet", 1.3), WHITE)
    b.wall(low, (start, 0.0), _HEIGHT, WHITE)
    b.wall(high, (start + _PANE, -3.0), _HEIGHT, WHITE)
    b.wall((start + _PANE, -3.0), low, _HEIGHT, Look("plaster", 2.0))
    b.pane((start + _PANE, 0.0, 0.0), (-_PANE, 0, 0), (0, 0, _HEIGHT))
    for x in (start + 0.03, start + 0.5 * _PANE, start + _PANE - 0.03):
        b.box((x, 0.0, 0.0), (0.06, 0.06, _HEIGHT), DARK)
    b.box((start + 0.5 * _PANE, 0.0, 0.0), (_PANE, 0.06, 0.08), DARK)
    b.table((start + 1.5, -1.6), 0.0, (1.6, 0.9, 0.74))
    b.hang((start + _PANE, -3.0), low, 1.5, 1.0, (1.5, 0.95), Look("whiteboard:2", None), 0.03)
    b.light((start + 1.5, -1.6, _HEIGHT - 0.1), (0.6, 0.6), 2.2, 4.0)


def _landmarks(b: RoomBuilder) -> None:
    """Add the few things that differ from place to place: extinguishers, boards, a bin, the ends."""
    for x, y in ((6.1, 0.12), (18.6, _WIDTH - 0.12), (31.5, 0.12)):
        b.cylinder((x, y, 0.35), 0.08, 0.48, Look("fabric", 0.4, tint=(0.75, 0.05, 0.04)))
    north = ((0.0, _WIDTH), (_LONG - _WIDTH, _WIDTH))
    b.hang(*north, 13.0, 1.15, (1.1, 0.8), Look("board:4", None))
    b.hang(*north, 28.9, 1.20, (0.6, 0.85), Look("poster:8", None))
    east = ((_LONG, _SHORT), (_LONG, 0.0))
    b.hang(*east, 10.0, 1.20, (0.6, 0.85), Look("poster:9", None))
    b.hang(*east, _SHORT - 1.0, 1.10, (0.9, 1.1), Look("painting:4", None))
    b.hang((0.0, 0.0), (0.0, _WIDTH), 1.1, 0.9, (1.3, 1.2), Look("window:5", None, emission=0.9), 0.06, METAL)
    top = ((_LONG - _WIDTH, _SHORT), (_LONG, _SHORT))
    b.hang(*top, 1.1, 0.0, (1.5, 2.15), Look("door:6", None), 0.05)
    b.hang(*top, 1.1, 2.25, (0.45, 0.2), Look("sign:2", None, emission=0.6), 0.05)
    p = Place((_LONG - 0.35, 3.0), 0.0)
    b.cylinder(p(0, 0), 0.17, 0.55, METAL)
    for x in np.arange(4.0, _LONG - 4, 9.6):
        exit_sign = Look("sign:3", None, tint=(0.5, 1.4, 0.7), emission=0.6)
        b.box((float(x), 0.5 * _WIDTH, _HEIGHT - 0.25), (0.02, 0.4, 0.18), DARK)
        b.box((float(x) - 0.012, 0.5 * _WIDTH, _HEIGHT - 0.25), (0.4, 0.01, 0.18), DARK, -0.5 * np.pi, front=exit_sign)
