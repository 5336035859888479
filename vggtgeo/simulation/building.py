"""The `building`: three floors, each a round of corridor of 12 x 9 m about its core, with a staircase between them.

For long runs: a lap goes round every floor, up the stairs and down again, so it closes a loop on each floor and sees
the stairs twice; the floors are alike, but for their colours, signs and pictures. The stairs are those of `staircase`.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from vggtgeo.simulation.furniture import METAL, WHITE, hang, lamp_panel, plant, shelf, wall
from vggtgeo.simulation.scene import Scene, finish
from vggtgeo.simulation.shapes import Look, SceneBuilder, Vector
from vggtgeo.simulation.staircase import FLIGHT, LANDING, LENGTH, STOREY, WIDTH, climb, flight
from vggtgeo.simulation.trajectories import Walk

_FLOORS = 3
_LOW, _HIGH = (-4.5, -9.4), (7.5, -0.12)
_AISLE, _HEIGHT = 2.2, 2.6
_EYE = 1.60
_DOOR = 1.35
"""Middle of the way between stairs and corridor, metres along x."""
_OPENING = (1.2, 2.1)
_PAINTS = ((0.72, 0.80, 0.70), (0.72, 0.76, 0.88), (0.90, 0.80, 0.66))


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
    for floor in range(_FLOORS):
        up += _round(floor * STOREY)
        if floor < _FLOORS - 1:
            up += climb(floor, _EYE)
    down = [point for floor in range(_FLOORS - 1) for point in climb(floor, _EYE)]
    return np.array([*up, *((x, y, z - 0.04) for x, y, z in reversed(down))])


BUILDING_WALK = Walk(way=_way(), speed=0.8, corner=0.25, turn=0.40, glance=0.15, pitch=-0.12)


def build_building(seed: int) -> Scene:
    """Build corridors with doors, boards and pictures, each floor in its colour, about a well of dog-leg stairs."""
    b = SceneBuilder(seed)
    for floor in range(_FLOORS):
        _corridor(b, floor)
        _stairs(b, floor)
    b.rectangle((0, 0, 0), (WIDTH, 0, 0), (0, LENGTH, 0), Look("tiles", 1.2))
    b.rectangle((0, LENGTH, _FLOORS * STOREY), (WIDTH, 0, 0), (0, -LENGTH, 0), WHITE)
    return finish(b, "building", ambient=0.40, exposure=0.72, texel=0.16)


def _corridor(b: SceneBuilder, floor: int) -> None:
    base, paint = floor * STOREY, _PAINTS[floor % len(_PAINTS)]
    (west, south), (east, north) = _LOW, _HIGH
    size = (east - west, north - south)
    b.rectangle((west, south, base), (size[0], 0, 0), (0, -south, 0), Look("carpet" if floor else "tiles", 1.4))
    b.rectangle((west, north, base + _HEIGHT), (size[0], 0, 0), (0, -size[1], 0), Look("ceiling", 1.2))
    middle = (0.5 * (west + east), 0.5 * (south + north), base + _HEIGHT + 0.02)
    b.box(middle, (*size, STOREY - _HEIGHT - 0.04), WHITE, edges=False)  # no light from floor to floor
    look = Look("plaster", 2.2, tint=paint)
    outer = [(west, north), (east, north), (east, south), (west, south), (west, north)]
    _with_opening(b, outer[0], outer[1], _HEIGHT, look, base)
    for start, end in pairwise(outer[1:]):
        wall(b, start, end, _HEIGHT, look, base)
    low, high = (west + _AISLE, south + _AISLE), (east - _AISLE, north - _AISLE)
    inner = [(high[0], high[1]), (low[0], high[1]), low, (high[0], low[1]), (high[0], high[1])]
    for start, end in pairwise(inner):
        wall(b, start, end, _HEIGHT, Look("wallpaper", 2.1, tint=paint, detail=0.05), base)
    sides = [*pairwise(outer), *pairwise(inner)]
    for number, (start, end) in enumerate(sides):
        _dress(b, start, end, base, 8 * floor + number, keep_free=number == 0)
    for number, (x, y) in enumerate(((east - 0.3, south + 0.3), (west + 0.3, south + 0.3), (west + 0.3, north - 0.3))):
        plant(b, (x, y, base), 0.9 + 0.15 * ((floor + number) % 3))
    shelf(b, (0.5 * (low[0] + high[0]), low[1] - 0.17, base), 0.0, variant=floor)
    for x in np.arange(west + 1.1, east, 2.45):
        for y in (north - 0.5 * _AISLE, south + 0.5 * _AISLE):
            lamp_panel(b, float(x), y, base + _HEIGHT, (0.9, 0.3), 2.0, 5.0)
    for y in np.arange(south + 3.4, north - 2.2, 2.4):
        for x in (west + 0.5 * _AISLE, east - 0.5 * _AISLE):
            lamp_panel(b, x, float(y), base + _HEIGHT, (0.3, 0.9), 2.0, 5.0)


def _dress(b: SceneBuilder, start: Vector, end: Vector, base: float, number: int, keep_free: bool) -> None:
    """Add doors and what hangs between them along one wall; nothing before the way to the stairs if `keep_free`."""
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    hang(b, start, end, 0.5 * length, base, (length, 0.09), Look("wood", 1.3), 0.015, Look("wood", 1.3))
    for place, along in enumerate(np.arange(1.0, length - 0.9, 1.5)):
        if keep_free and abs(start[0] + along - _DOOR) < 1.4:
            continue
        kind, variant = (number + place) % 4, 7 * number + place
        if kind == 0:
            hang(b, start, end, float(along), base, (0.95, 2.05), Look(f"door:{variant % 12}", None), 0.05)
            hang(b, start, end, float(along) + 0.68, base + 1.5, (0.2, 0.14), Look(f"sign:{variant % 20}", None), 0.015)
        elif kind == 1:
            hang(b, start, end, float(along), base + 1.2, (0.6, 0.85), Look(f"poster:{variant % 24}", None))
        elif kind == 2:
            hang(b, start, end, float(along), base + 1.15, (1.0, 0.75), Look(f"board:{variant % 8}", None))
        else:
            hang(b, start, end, float(along), base + 1.25, (0.9, 0.7), Look(f"painting:{variant % 16}", None))


def _with_opening(b: SceneBuilder, start: Vector, end: Vector, height: float, look: Look, base: float) -> None:
    """Add a wall along x with the way between stairs and corridor left open."""
    width, top = _OPENING
    way = 1.0 if end[0] > start[0] else -1.0
    near, far = (_DOOR - 0.5 * way * width, start[1]), (_DOOR + 0.5 * way * width, start[1])
    wall(b, start, near, height, look, base)
    wall(b, far, end, height, look, base)
    wall(b, near, far, height - top, look, base + top)


def _stairs(b: SceneBuilder, floor: int) -> None:
    """Add one storey of the well: walls, landing, both flights up to the next floor."""
    base, half = floor * STOREY, (floor + 0.5) * STOREY
    stone = Look("terrazzo", 1.3, tint=(0.9, 0.88, 0.85))
    corners = [(0.0, 0.0), (0.0, LENGTH), (WIDTH, LENGTH), (WIDTH, 0.0)]
    paint = Look("plaster", 2.0, tint=_PAINTS[(floor + 1) % len(_PAINTS)])
    for start, end in pairwise(corners):
        wall(b, start, end, STOREY, paint, base)
    _with_opening(b, corners[3], corners[0], STOREY, paint, base)
    for side in (-0.5, 0.5):
        b.box((_DOOR + side * (_OPENING[0] + 0.08), -0.06, base), (0.08, 0.16, _OPENING[1]), METAL)
    b.box((_DOOR, -0.06, base + _OPENING[1]), (_OPENING[0] + 0.16, 0.16, 0.08), METAL)
    hang(b, corners[0], corners[1], 0.7, base + 1.3, (0.5, 0.7), Look(f"poster:{10 + floor}", None))
    hang(b, corners[2], corners[3], LENGTH - 0.7, base + 1.3, (0.45, 0.45), Look(f"sign:{floor + 5}", None))
    if floor:
        b.box((0.5 * WIDTH, 0.5 * LANDING, base - 0.18), (WIDTH, LANDING, 0.18), stone, top=Look("tiles", 1.2))
    lamp_panel(b, 0.5 * WIDTH, 0.7, base + STOREY - 0.19, (0.8, 0.3), 2.4, 5.0)
    if floor < _FLOORS - 1:
        b.box((0.5 * WIDTH, LENGTH - 0.5 * LANDING, half - 0.18), (WIDTH, LANDING, 0.18), stone)
        flight(b, WIDTH - 0.5 * FLIGHT, base, 1)
        flight(b, 0.5 * FLIGHT, half, -1)
        hang(
            b, corners[1], corners[2], 0.5 * WIDTH, half + 0.95, (1.2, 1.1), Look(f"window:{floor}", None, emission=0.7)
        )
        hang(b, corners[2], corners[3], 0.7, half + 1.2, (0.5, 0.7), Look(f"painting:{floor + 5}", None))
        lamp_panel(b, 0.5 * WIDTH, LENGTH - 0.7, half + STOREY - 0.19, (0.8, 0.3), 2.4, 7.0)
