"""The `staircase`: four floors of dog-leg stairs in a well of 2.7 x 6 m, with landings, rails, doors and windows."""

from __future__ import annotations

import numpy as np

from vggtgeo.simulation.furniture import DARK, METAL, WHITE, hang, lamp_panel, plant, railing, wall
from vggtgeo.simulation.scene import Scene, finish
from vggtgeo.simulation.shapes import Look, SceneBuilder
from vggtgeo.simulation.trajectories import Walk

_FLOORS = 4
STEPS = 10  # in each of the two flights of a floor
_RISE, _RUN = 0.165, 0.28
WIDTH, LENGTH = 2.7, 6.0
FLIGHT = 1.25
LANDING = 0.5 * (LENGTH - STEPS * _RUN)
STOREY = 2 * STEPS * _RISE
_EYE = 1.60
_PAINTS = ((0.62, 0.72, 0.62), (0.62, 0.68, 0.80), (0.85, 0.72, 0.55), (0.75, 0.60, 0.60))


def climb(floor: int, eye: float) -> list[tuple[float, float, float]]:
    """Return way points of a camera at height `eye` from `floor` up to the next, x, y, z in metres."""
    east, west = WIDTH - 0.5 * FLIGHT, 0.5 * FLIGHT
    near, far = 0.62 * LANDING, LENGTH - 0.62 * LANDING
    base, half = floor * STOREY + eye, (floor + 0.5) * STOREY + eye
    up = [(east, near, base), (east, LANDING, base), (east, LENGTH - LANDING, half), (east, far, half)]
    up += [(west, far, half), (west, LENGTH - LANDING, half)]
    return [*up, (west, LANDING, base + STOREY), (west, near, base + STOREY)]


def _there_and_back() -> np.ndarray:
    """Return a way from the lowest floor up to the highest and down again, a little to the side."""
    up = [point for floor in range(_FLOORS - 1) for point in climb(floor, _EYE)]
    down = [(x + (0.12 if x < 0.5 * WIDTH else -0.12), y, z - 0.04) for x, y, z in reversed(up)]
    return np.array([*up, *down])


STAIRCASE_WALK = Walk(way=_there_and_back(), speed=0.5, corner=0.22, turn=0.30, glance=0.15, pitch=-0.16)


def build_staircase(seed: int) -> Scene:
    """Build concrete flights between two-coloured walls, with doors, numbers and windows.

    Each floor has a door and a number, each half landing a window.
    """
    b = SceneBuilder(seed)
    height = _FLOORS * STOREY
    stone = Look("terrazzo", 1.3, tint=(0.9, 0.88, 0.85))
    b.rectangle((0, 0, 0), (WIDTH, 0, 0), (0, LENGTH, 0), Look("tiles", 1.2))
    b.rectangle((0, LENGTH, height), (WIDTH, 0, 0), (0, -LENGTH, 0), WHITE)
    for floor in range(_FLOORS):
        base = floor * STOREY
        _walls(b, base, floor)
        if floor:
            b.box((0.5 * WIDTH, 0.5 * LANDING, base - 0.18), (WIDTH, LANDING, 0.18), stone, top=Look("tiles", 1.2))
        if floor < _FLOORS - 1:
            half = base + 0.5 * STOREY
            b.box((0.5 * WIDTH, LENGTH - 0.5 * LANDING, half - 0.18), (WIDTH, LANDING, 0.18), stone)
            flight(b, WIDTH - 0.5 * FLIGHT, base, 1)
            flight(b, 0.5 * FLIGHT, half, -1)
            above = half + STOREY - 0.18 if floor < _FLOORS - 2 else height
            lamp_panel(b, 0.5 * WIDTH, LENGTH - 0.7, above, (0.8, 0.3), 2.4 if floor < _FLOORS - 2 else 6.0, 7.0)
        lamp_panel(b, 0.5 * WIDTH, 0.7, base + STOREY - 0.18, (0.8, 0.3), 2.4, 5.0)
    top, edge = (_FLOORS - 1) * STOREY, LANDING - 0.05
    railing(b, (FLIGHT + 0.1, edge, top), (WIDTH - 0.1, edge, top), 1.0, METAL)
    plant(b, (WIDTH - 0.3, 0.35), 1.2)
    return finish(b, "staircase", ambient=0.36, exposure=0.72, texel=0.12)


def flight(b: SceneBuilder, x: float, base: float, way: int) -> None:
    """Add ten steps up from `base` along +y (`way` 1) or -y (-1), an underside, and a railing at the well."""
    start = LANDING if way > 0 else LENGTH - LANDING
    stone = Look("terrazzo", 1.3, tint=(0.9, 0.88, 0.85))
    for step in range(STEPS):
        y = start + way * (step + 0.5) * _RUN
        low = max(0.0, step * _RISE - 0.12)
        size = (FLIGHT, _RUN, (step + 1) * _RISE - low)
        b.box((x, y, base + low), size, stone)
        nose = start + way * (step * _RUN + 0.02)
        b.box((x, nose, base + (step + 1) * _RISE), (FLIGHT - 0.1, 0.04, 0.004), DARK, edges=False, shadow=False)
    inner = x - 0.5 * FLIGHT + 0.04 if way > 0 else x + 0.5 * FLIGHT - 0.04
    top = base + STEPS * _RISE
    railing(b, (inner, start, base), (inner, start + way * STEPS * _RUN, top), 0.95, METAL, 0.45)


def _walls(b: SceneBuilder, base: float, floor: int) -> None:
    """Add one storey of the four walls: coloured to 1.2 m above each floor, white above."""
    corners = [(0.0, 0.0), (0.0, LENGTH), (WIDTH, LENGTH), (WIDTH, 0.0)]
    paint = Look("plaster", 2.0, tint=_PAINTS[floor % len(_PAINTS)])
    for side in range(4):
        start, end = corners[side], corners[(side + 1) % 4]
        wall(b, start, end, 1.2, paint, base, edges=True)
        wall(b, start, end, STOREY - 1.2, Look("plaster", 2.3, detail=0.04), base + 1.2)
    hang(b, corners[3], corners[0], 0.9, base, (0.95, 2.05), Look("door:7", None), 0.05, DARK)
    hang(b, corners[3], corners[0], 1.8, base + 1.5, (0.35, 0.35), Look(f"sign:{floor + 10}", None), 0.02)
    hang(b, corners[0], corners[1], 0.6, base + 1.3, (0.5, 0.7), Look(f"poster:{70 + floor}", None))
    if floor < _FLOORS - 1:
        half = base + 0.5 * STOREY
        view = Look(f"window:{floor}", None, emission=0.7)
        hang(b, corners[1], corners[2], 0.5 * WIDTH, half + 0.95, (1.2, 1.1), view, 0.06, METAL)
        hang(b, corners[2], corners[3], 0.7, half + 1.2, (0.5, 0.7), Look(f"painting:{floor + 5}", None))
