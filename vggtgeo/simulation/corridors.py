"""The worlds of corridors and stairs.

`corridor`: an L of 38 + 20 m, 2.2 m wide, with bare white walls, equal doors and panes of glass. Built to be hard,
with hardly any texture, the same door every 3.2 m, mirrors in glass, blank ends to turn before.

`staircase`: four floors of dog-leg stairs in a well of 2.7 x 6 m, with landings, rails, doors and windows.

`building`: three floors, each a round of corridor of 12 x 9 m about its core, with such a staircase between them. For
long runs: a lap goes round every floor, up the stairs and down again, so it closes a loop on each floor and sees the
stairs twice; the floors are alike, but for their colours, signs and pictures.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from vggtgeo.simulation.furniture import DARK, METAL, WHITE, Place, RoomBuilder, sides_of
from vggtgeo.simulation.scene import Scene, finish
from vggtgeo.simulation.shapes import Look, Vector
from vggtgeo.simulation.trajectories import Walk

_LONG, _SHORT, _AISLE_WIDTH, _CEILING = 38.0, 20.0, 2.2, 2.6
_LINOLEUM = Look("white", 1.6, tint=(0.36, 0.38, 0.40), detail=0.05)
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
    b.floor_and_ceiling((0, 0), (_LONG, _AISLE_WIDTH), _CEILING, _LINOLEUM, Look("ceiling", 1.2, detail=0.03))
    low, high = (_LONG - _AISLE_WIDTH, _AISLE_WIDTH), (_LONG, _SHORT)
    b.floor_and_ceiling(low, high, _CEILING, _LINOLEUM, Look("ceiling", 1.2, detail=0.03))
    inner = _LONG - _AISLE_WIDTH
    _plain_wall(b, (0, 0), (0, _AISLE_WIDTH), False)
    _plain_wall(b, (0, _AISLE_WIDTH), (inner, _AISLE_WIDTH))
    _plain_wall(b, (inner, _AISLE_WIDTH), (inner, _SHORT))
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
        b.lamp_panel(float(x), 0.5 * _AISLE_WIDTH, _CEILING, (1.2, 0.3), power=2.6, reach=6.0)
    for y in np.arange(_AISLE_WIDTH + 1.6, _SHORT, 3.2):
        b.lamp_panel(_LONG - 0.5 * _AISLE_WIDTH, float(y), _CEILING, (0.3, 1.2), power=2.6, reach=6.0)
    return finish(b, "corridor", ambient=0.42, exposure=0.72, texel=0.16)


def _plain_wall(b: RoomBuilder, start: Vector, end: Vector, doors: bool = True) -> None:
    """Add white paint, a skirting, and the same grey door with its sign every 3.2 m."""
    b.wall(start, end, _CEILING, WHITE, edges=True)
    length = b.skirting(start, end, 0.10, 0.012, _GREY)
    if not doors:
        return
    for along in np.arange(1.6, length - 0.7, 3.2):
        b.hang((start, end), float(along), 0.0, (1.02, 2.10), _GREY, 0.03, _GREY)
        leaf = Look("white", 1.0, tint=(0.55, 0.58, 0.60), detail=0.02)
        b.hang((start, end), float(along), 0.01, (0.90, 2.03), leaf, 0.045, _GREY)
        b.hang((start, end), float(along) + 0.36, 1.02, (0.14, 0.03), METAL, 0.09, METAL)
        b.hang((start, end), float(along) + 0.72, 1.50, (0.16, 0.12), Look("sign:1", None), 0.015)


def _meeting_room(b: RoomBuilder, start: float) -> None:
    """Add a dim room of 3 x 3 m south of the corridor behind one pane of glass in a frame."""
    low, high = (start, -3.0), (start + _PANE, 0.0)
    b.floor_and_ceiling(low, high, _CEILING, Look("carpet", 1.3), WHITE)
    b.wall(low, (start, 0.0), _CEILING, WHITE)
    b.wall(high, (start + _PANE, -3.0), _CEILING, WHITE)
    b.wall((start + _PANE, -3.0), low, _CEILING, Look("plaster", 2.0))
    b.pane((start + _PANE, 0.0, 0.0), (-_PANE, 0, 0), (0, 0, _CEILING))
    for x in (start + 0.03, start + 0.5 * _PANE, start + _PANE - 0.03):
        b.box((x, 0.0, 0.0), (0.06, 0.06, _CEILING), DARK)
    b.box((start + 0.5 * _PANE, 0.0, 0.0), (_PANE, 0.06, 0.08), DARK)
    b.table((start + 1.5, -1.6), 0.0, (1.6, 0.9, 0.74))
    b.hang(((start + _PANE, -3.0), low), 1.5, 1.0, (1.5, 0.95), Look("whiteboard:2", None), 0.03)
    b.light((start + 1.5, -1.6, _CEILING - 0.1), (0.6, 0.6), 2.2, 4.0)


def _landmarks(b: RoomBuilder) -> None:
    """Add the few things that differ from place to place: extinguishers, boards, a bin, the ends."""
    for x, y in ((6.1, 0.12), (18.6, _AISLE_WIDTH - 0.12), (31.5, 0.12)):
        b.cylinder((x, y, 0.35), 0.08, 0.48, Look("fabric", 0.4, tint=(0.75, 0.05, 0.04)))
    north = ((0.0, _AISLE_WIDTH), (_LONG - _AISLE_WIDTH, _AISLE_WIDTH))
    b.hang(north, 13.0, 1.15, (1.1, 0.8), Look("board:4", None))
    b.hang(north, 28.9, 1.20, (0.6, 0.85), Look("poster:8", None))
    east = ((_LONG, _SHORT), (_LONG, 0.0))
    b.hang(east, 10.0, 1.20, (0.6, 0.85), Look("poster:9", None))
    b.hang(east, _SHORT - 1.0, 1.10, (0.9, 1.1), Look("painting:4", None))
    b.hang(((0.0, 0.0), (0.0, _AISLE_WIDTH)), 1.1, 0.9, (1.3, 1.2), Look("window:5", None, emission=0.9), 0.06, METAL)
    top = ((_LONG - _AISLE_WIDTH, _SHORT), (_LONG, _SHORT))
    b.hang(top, 1.1, 0.0, (1.5, 2.15), Look("door:6", None), 0.05)
    b.hang(top, 1.1, 2.25, (0.45, 0.2), Look("sign:2", None, emission=0.6), 0.05)
    p = Place((_LONG - 0.35, 3.0), 0.0)
    b.cylinder(p(0, 0), 0.17, 0.55, METAL)
    exit_sign = Look("sign:3", None, tint=(0.5, 1.4, 0.7), emission=0.6)
    y, z = 0.5 * _AISLE_WIDTH, _CEILING - 0.25
    for x in np.arange(4.0, _LONG - 4, 9.6):
        b.box((float(x), y, z), (0.02, 0.4, 0.18), DARK)
        b.box((float(x) - 0.012, y, z), (0.4, 0.01, 0.18), DARK, -0.5 * np.pi, front=exit_sign)


_FLOORS = 4
_STEPS = 10  # in each of the two flights of a floor
_RISE, _RUN = 0.165, 0.28
_WIDTH, _LENGTH = 2.7, 6.0
_FLIGHT = 1.25
_LANDING = 0.5 * (_LENGTH - _STEPS * _RUN)
_STOREY = 2 * _STEPS * _RISE
_EYE = 1.60
_STONE = Look("terrazzo", 1.3, tint=(0.9, 0.88, 0.85))
_PAINTS = ((0.62, 0.72, 0.62), (0.62, 0.68, 0.80), (0.85, 0.72, 0.55), (0.75, 0.60, 0.60))


def _climb(floor: int, eye: float) -> list[tuple[float, float, float]]:
    """Return way points of a camera at height `eye` from `floor` up to the next, x, y, z in metres."""
    east, west = _WIDTH - 0.5 * _FLIGHT, 0.5 * _FLIGHT
    near, far = 0.62 * _LANDING, _LENGTH - 0.62 * _LANDING
    base, half = floor * _STOREY + eye, (floor + 0.5) * _STOREY + eye
    up = [(east, near, base), (east, _LANDING, base), (east, _LENGTH - _LANDING, half), (east, far, half)]
    up += [(west, far, half), (west, _LENGTH - _LANDING, half)]
    return [*up, (west, _LANDING, base + _STOREY), (west, near, base + _STOREY)]


def _there_and_back() -> np.ndarray:
    """Return a way from the lowest floor up to the highest and down again, a little to the side."""
    up = [point for floor in range(_FLOORS - 1) for point in _climb(floor, _EYE)]
    down = [(x + (0.12 if x < 0.5 * _WIDTH else -0.12), y, z - 0.04) for x, y, z in reversed(up)]
    return np.array([*up, *down])


STAIRCASE_WALK = Walk(way=_there_and_back(), speed=0.5, corner=0.22, turn=0.30, glance=0.15, pitch=-0.16)


def build_staircase(seed: int) -> Scene:
    """Build concrete flights between two-coloured walls, with doors, numbers and windows.

    Each floor has a door and a number, each half landing a window.
    """
    b = RoomBuilder(seed)
    height = _FLOORS * _STOREY
    b.floor_and_ceiling((0, 0), (_WIDTH, _LENGTH), height, Look("tiles", 1.2), WHITE)
    for floor in range(_FLOORS):
        base = floor * _STOREY
        _walls(b, base, floor)
        if floor:
            _landing(b, base)
        if floor < _FLOORS - 1:
            half = base + 0.5 * _STOREY
            _flights(b, base, half)
            above = half + _STOREY - 0.18 if floor < _FLOORS - 2 else height
            b.lamp_panel(0.5 * _WIDTH, _LENGTH - 0.7, above, (0.8, 0.3), 2.4 if floor < _FLOORS - 2 else 6.0, 7.0)
        b.lamp_panel(0.5 * _WIDTH, 0.7, base + _STOREY - 0.18, (0.8, 0.3), 2.4, 5.0)
    top, edge = (_FLOORS - 1) * _STOREY, _LANDING - 0.05
    b.railing((_FLIGHT + 0.1, edge, top), (_WIDTH - 0.1, edge, top), 1.0, METAL)
    b.plant((_WIDTH - 0.3, 0.35), 1.2)
    return finish(b, "staircase", ambient=0.36, exposure=0.72, texel=0.12)


def _landing(b: RoomBuilder, base: float) -> None:
    b.box((0.5 * _WIDTH, 0.5 * _LANDING, base - 0.18), (_WIDTH, _LANDING, 0.18), _STONE, top=Look("tiles", 1.2))


def _flights(b: RoomBuilder, base: float, half: float) -> None:
    """Add both flights from the floor at `base` to the next one, and the landing at `half`."""
    b.box((0.5 * _WIDTH, _LENGTH - 0.5 * _LANDING, half - 0.18), (_WIDTH, _LANDING, 0.18), _STONE)
    _flight(b, _WIDTH - 0.5 * _FLIGHT, base, 1)
    _flight(b, 0.5 * _FLIGHT, half, -1)


def _flight(b: RoomBuilder, x: float, base: float, way: int) -> None:
    """Add ten steps up from `base` along +y (`way` 1) or -y (-1), an underside, and a railing at the well."""
    start = _LANDING if way > 0 else _LENGTH - _LANDING
    for step in range(_STEPS):
        y = start + way * (step + 0.5) * _RUN
        low = max(0.0, step * _RISE - 0.12)
        size = (_FLIGHT, _RUN, (step + 1) * _RISE - low)
        b.box((x, y, base + low), size, _STONE)
        nose = start + way * (step * _RUN + 0.02)
        b.box((x, nose, base + (step + 1) * _RISE), (_FLIGHT - 0.1, 0.04, 0.004), DARK, edges=False, shadow=False)
    inner = x - 0.5 * _FLIGHT + 0.04 if way > 0 else x + 0.5 * _FLIGHT - 0.04
    top = base + _STEPS * _RISE
    b.railing((inner, start, base), (inner, start + way * _STEPS * _RUN, top), 0.95, METAL, 0.45)


def _walls(b: RoomBuilder, base: float, floor: int) -> None:
    """Add one storey of the four walls: coloured to 1.2 m above each floor, white above."""
    paint = Look("plaster", 2.0, tint=_PAINTS[floor % len(_PAINTS)])
    west, north, east, south = sides_of((_WIDTH, _LENGTH))
    for start, end in (west, north, east, south):
        b.wall(start, end, 1.2, paint, base, edges=True)
        b.wall(start, end, _STOREY - 1.2, Look("plaster", 2.3, detail=0.04), base + 1.2)
    b.hang(south, 0.9, base, (0.95, 2.05), Look("door:7", None), 0.05, DARK)
    b.hang(south, 1.8, base + 1.5, (0.35, 0.35), Look(f"sign:{floor + 10}", None), 0.02)
    b.hang(west, 0.6, base + 1.3, (0.5, 0.7), Look(f"poster:{70 + floor}", None))
    if floor < _FLOORS - 1:
        half = base + 0.5 * _STOREY
        view = Look(f"window:{floor}", None, emission=0.7)
        b.hang(north, 0.5 * _WIDTH, half + 0.95, (1.2, 1.1), view, 0.06, METAL)
        b.hang(east, 0.7, half + 1.2, (0.5, 0.7), Look(f"painting:{floor + 5}", None))


_STOREYS = 3
_LOW, _HIGH = (-4.5, -9.4), (7.5, -0.12)
_AISLE, _HEIGHT = 2.2, 2.6
_DOOR = 1.35
"""Middle of the way between stairs and corridor, metres along x."""
_OPENING = (1.2, 2.1)
_FLOOR_PAINTS = ((0.72, 0.80, 0.70), (0.72, 0.76, 0.88), (0.90, 0.80, 0.66))


def _round(base: float) -> list[tuple[float, float, float]]:
    """Return a way once round the corridor of a floor, from the stairs and back to them."""
    (west, south), (east, north) = _LOW, _HIGH
    half, z = 0.5 * _AISLE, base + _EYE
    out, back = _DOOR + 0.15, _DOOR - 0.15
    ring = [(out, north - half), (east - half, north - half), (east - half, south + half)]
    ring += [(west + half, south + half), (west + half, north - half), (back, north - half)]
    return [(_DOOR, -0.06, z), *((x, y, z) for x, y in ring), (_DOOR, -0.06, z)]


def _way() -> np.ndarray:
    """Round each floor on the way up, then down the stairs."""
    up = []
    for floor in range(_STOREYS):
        up += _round(floor * _STOREY)
        if floor < _STOREYS - 1:
            up += _climb(floor, _EYE)
    down = [point for floor in range(_STOREYS - 1) for point in _climb(floor, _EYE)]
    return np.array([*up, *((x, y, z - 0.04) for x, y, z in reversed(down))])


BUILDING_WALK = Walk(way=_way(), speed=0.8, corner=0.25, turn=0.40, glance=0.15, pitch=-0.12)


def build_building(seed: int) -> Scene:
    """Build corridors with doors, boards and pictures, each floor in its colour, about a well of dog-leg stairs."""
    b = RoomBuilder(seed)
    for floor in range(_STOREYS):
        _corridor(b, floor)
        _stairs(b, floor)
    b.floor_and_ceiling((0, 0), (_WIDTH, _LENGTH), _STOREYS * _STOREY, Look("tiles", 1.2), WHITE)
    return finish(b, "building", ambient=0.40, exposure=0.72, texel=0.16)


def _corridor(b: RoomBuilder, floor: int) -> None:
    base, paint = floor * _STOREY, _FLOOR_PAINTS[floor % len(_FLOOR_PAINTS)]
    (west, south), (east, north) = _LOW, _HIGH
    size = (east - west, north - south)
    b.rectangle((west, south, base), (size[0], 0, 0), (0, -south, 0), Look("carpet" if floor else "tiles", 1.4))
    b.rectangle((west, north, base + _HEIGHT), (size[0], 0, 0), (0, -size[1], 0), Look("ceiling", 1.2))
    middle = (0.5 * (west + east), 0.5 * (south + north), base + _HEIGHT + 0.02)
    b.box(middle, (*size, _STOREY - _HEIGHT - 0.04), WHITE, edges=False)  # no light from floor to floor
    look = Look("plaster", 2.2, tint=paint)
    outer = [(west, north), (east, north), (east, south), (west, south), (west, north)]
    _with_opening(b, outer[0], outer[1], _HEIGHT, look, base)
    for start, end in pairwise(outer[1:]):
        b.wall(start, end, _HEIGHT, look, base)
    low, high = (west + _AISLE, south + _AISLE), (east - _AISLE, north - _AISLE)
    inner = [(high[0], high[1]), (low[0], high[1]), low, (high[0], low[1]), (high[0], high[1])]
    for start, end in pairwise(inner):
        b.wall(start, end, _HEIGHT, Look("wallpaper", 2.1, tint=paint, detail=0.05), base)
    sides = [*pairwise(outer), *pairwise(inner)]
    for number, (start, end) in enumerate(sides):
        _dress_corridor(b, start, end, base, 8 * floor + number, keep_free=number == 0)
    for number, (x, y) in enumerate(((east - 0.3, south + 0.3), (west + 0.3, south + 0.3), (west + 0.3, north - 0.3))):
        b.plant((x, y, base), 0.9 + 0.15 * ((floor + number) % 3))
    b.shelf((0.5 * (low[0] + high[0]), low[1] - 0.17, base), 0.0, variant=floor)
    for x in np.arange(west + 1.1, east, 2.45):
        for y in (north - 0.5 * _AISLE, south + 0.5 * _AISLE):
            b.lamp_panel(float(x), y, base + _HEIGHT, (0.9, 0.3), 2.0, 5.0)
    for y in np.arange(south + 3.4, north - 2.2, 2.4):
        for x in (west + 0.5 * _AISLE, east - 0.5 * _AISLE):
            b.lamp_panel(x, float(y), base + _HEIGHT, (0.3, 0.9), 2.0, 5.0)


def _dress_corridor(b: RoomBuilder, start: Vector, end: Vector, base: float, number: int, keep_free: bool) -> None:
    """Add doors and what hangs between them along one wall; nothing before the way to the stairs if `keep_free`."""
    length = b.skirting(start, end, 0.09, 0.015, Look("wood", 1.3), base)
    for place, along in enumerate(np.arange(1.0, length - 0.9, 1.5)):
        if keep_free and abs(start[0] + along - _DOOR) < 1.4:
            continue
        kind, variant = (number + place) % 4, 7 * number + place
        if kind == 0:
            b.hang((start, end), float(along), base, (0.95, 2.05), Look(f"door:{variant % 12}", None), 0.05)
            b.hang(
                (start, end), float(along) + 0.68, base + 1.5, (0.2, 0.14), Look(f"sign:{variant % 20}", None), 0.015
            )
        elif kind == 1:
            b.hang((start, end), float(along), base + 1.2, (0.6, 0.85), Look(f"poster:{variant % 24}", None))
        elif kind == 2:
            b.hang((start, end), float(along), base + 1.15, (1.0, 0.75), Look(f"board:{variant % 8}", None))
        else:
            b.hang((start, end), float(along), base + 1.25, (0.9, 0.7), Look(f"painting:{variant % 16}", None))


def _with_opening(b: RoomBuilder, start: Vector, end: Vector, height: float, look: Look, base: float) -> None:
    """Add a wall along x with the way between stairs and corridor left open."""
    width, top = _OPENING
    way = 1.0 if end[0] > start[0] else -1.0
    near, far = (_DOOR - 0.5 * way * width, start[1]), (_DOOR + 0.5 * way * width, start[1])
    b.wall(start, near, height, look, base)
    b.wall(far, end, height, look, base)
    b.wall(near, far, height - top, look, base + top)


def _stairs(b: RoomBuilder, floor: int) -> None:
    """Add one storey of the well: walls, landing, both flights up to the next floor."""
    base, half = floor * _STOREY, (floor + 0.5) * _STOREY
    paint = Look("plaster", 2.0, tint=_FLOOR_PAINTS[(floor + 1) % len(_FLOOR_PAINTS)])
    west, north, east, south = sides_of((_WIDTH, _LENGTH))
    for start, end in (west, north, east):
        b.wall(start, end, _STOREY, paint, base)
    _with_opening(b, *south, _STOREY, paint, base)
    for side in (-0.5, 0.5):
        b.box((_DOOR + side * (_OPENING[0] + 0.08), -0.06, base), (0.08, 0.16, _OPENING[1]), METAL)
    b.box((_DOOR, -0.06, base + _OPENING[1]), (_OPENING[0] + 0.16, 0.16, 0.08), METAL)
    b.hang(west, 0.7, base + 1.3, (0.5, 0.7), Look(f"poster:{10 + floor}", None))
    b.hang(east, _LENGTH - 0.7, base + 1.3, (0.45, 0.45), Look(f"sign:{floor + 5}", None))
    if floor:
        _landing(b, base)
    b.lamp_panel(0.5 * _WIDTH, 0.7, base + _STOREY - 0.19, (0.8, 0.3), 2.4, 5.0)
    if floor < _STOREYS - 1:
        _flights(b, base, half)
        view = Look(f"window:{floor}", None, emission=0.7)
        b.hang(north, 0.5 * _WIDTH, half + 0.95, (1.2, 1.1), view)
        b.hang(east, 0.7, half + 1.2, (0.5, 0.7), Look(f"painting:{floor + 5}", None))
        b.lamp_panel(0.5 * _WIDTH, _LENGTH - 0.7, half + _STOREY - 0.19, (0.8, 0.3), 2.4, 7.0)
