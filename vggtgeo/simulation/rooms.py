"""The furnished worlds, well textured.

`office`: an open-plan floor of 16 x 11 x 2.8 m with islands of desks, shelves and boards.

`room`: a living room of 6 x 5 x 3 m with a desk corner.

`hall`: an atrium of 36 x 22 x 8 m with columns, a gallery, banners and high windows; large and far.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.simulation.furniture import BRICK, DARK, METAL, PLASTER, WOOD, Place, RoomBuilder, sides_of
from vggtgeo.simulation.scene import Scene, finish
from vggtgeo.simulation.shapes import Look, Vector
from vggtgeo.simulation.trajectories import Walk

_OFFICE_SIZE = (16.0, 11.0)
_OFFICE_HEIGHT = 2.8
_ON_THE_WALL = {"poster": 0.3, "painting": 0.2, "board": 0.15, "whiteboard": 0.1, "window": 0.15, "door": 0.1}

OFFICE_WALK = Walk(
    way=np.array(
        [
            [8.0, 5.6, 1.60],
            [14.6, 5.6, 1.55],
            [14.6, 9.7, 1.60],
            [8.0, 9.8, 1.55],
            [1.4, 9.7, 1.60],
            [1.4, 5.5, 1.60],
            [1.4, 1.3, 1.55],
            [8.0, 1.2, 1.60],
            [14.6, 1.3, 1.60],
            [14.6, 4.9, 1.55],
            [9.0, 5.3, 1.60],
            [8.0, 3.4, 1.60],
            [7.0, 5.3, 1.55],
        ]
    ),
    speed=0.7,
    corner=0.40,
    turn=0.45,
    glance=0.45,
    pitch=-0.14,
)


def build_office(seed: int) -> Scene:
    """Build four islands of four desks, lined by shelves, boards, doors and windows."""
    b = RoomBuilder(seed)
    b.floor_and_ceiling((0, 0), _OFFICE_SIZE, _OFFICE_HEIGHT, Look("carpet", 1.3), Look("ceiling", 1.2, detail=0.05))
    looks = (BRICK, PLASTER, PLASTER.tinted(0.86, 0.93, 1.0), PLASTER.tinted(1.0, 0.95, 0.85))
    for side, (start, end) in enumerate(sides_of(_OFFICE_SIZE)):
        b.wall(start, end, _OFFICE_HEIGHT, looks[side])
        _dress_office(b, start, end, b.skirting(start, end, 0.10, 0.015), side)
    variant = 0
    for x in (4.5, 11.5):
        for y in (3.4, 7.7):
            _island(b, (x, y), variant)
            variant += 4
    _pillars_and_corners(b)
    for x in (2.7, 6.2, 9.8, 13.3):
        for y in (1.9, 5.5, 9.1):
            b.lamp_panel(x, y, _OFFICE_HEIGHT, power=6.0, reach=7.0)
    return finish(b, "office", ambient=0.34, exposure=0.70, texel=0.14)


def _island(b: RoomBuilder, at: Vector, variant: int) -> None:
    """Add four desks back to back with screens of cloth between them."""
    place = Place(at, 0.0)
    for column, x in enumerate((-0.78, 0.78)):
        for row, yaw in enumerate((0.0, np.pi)):
            y = -0.40 if row == 0 else 0.40
            number = variant + 2 * column + row
            b.desk(place(x, y), yaw, number % 7)
            turn = float(b.rng.uniform(-0.6, 0.6))
            away = 2.4 * y + float(b.rng.uniform(-0.05, 0.10)) * np.sign(y)
            b.chair(place(x + 0.1, away), yaw + np.pi + turn, (0.08, 0.12 + 0.05 * (number % 3), 0.30))
    panel = Look("fabric", 0.6, tint=((0.25, 0.42, 0.50), (0.55, 0.30, 0.22), (0.35, 0.45, 0.22))[variant // 4 % 3])
    b.box(place(0, 0, 0.55), (3.1, 0.03, 0.62), panel)
    b.box(place(0, 0, 0.75), (0.03, 1.2, 0.35), panel)


def _dress_office(b: RoomBuilder, start: Vector, end: Vector, length: float, side: int) -> None:
    """Add things on one wall, about one in 2 m, in an order drawn from the seed."""
    along, number = 1.1, 10 * side
    while along < length - 1.0:
        kind = str(b.rng.choice(list(_ON_THE_WALL), p=list(_ON_THE_WALL.values())))
        look = Look(f"{kind}:{number}", None, emission=0.7 if kind == "window" else 0.0)
        if kind == "door":
            b.hang((start, end), along, 0.0, (0.95, 2.05), look, 0.05)
        else:
            width, height = b.rng.uniform([0.6, 0.6], [1.4, 1.1]) * (0.75 if kind == "poster" else 1.0)
            b.hang((start, end), along, 1.05 + float(b.rng.uniform(0, 0.35)), (width, height), look, 0.03)
        along += float(b.rng.uniform(1.5, 2.3))
        number += 1


def _pillars_and_corners(b: RoomBuilder) -> None:
    """Add low shelves along the walls, two pillars, and corners with plants and a sofa."""
    for index, x in enumerate((3.6, 6.0, 10.4, 12.6)):
        b.shelf((x, 0.20), np.pi, 1.3, 0.85, 3 * index % 9)
    for index, x in enumerate((4.4, 9.6, 12.2)):
        b.shelf((x, 10.80), 0.0, 1.3, (0.85, 1.9, 1.25)[index], 3 * index % 9)
    b.cabinet((15.72, 7.5), -0.5 * np.pi)
    b.cabinet((15.72, 3.1), -0.5 * np.pi, (1.2, 0.45, 0.8), "books:8")
    b.sofa((0.5, 7.4), 0.5 * np.pi, (0.24, 0.30, 0.12), 1.8)
    b.cabinet((0.28, 3.4), 0.5 * np.pi, (1.2, 0.45, 0.8), "books:7")
    b.box((8.0, 7.7, 0), (0.5, 0.5, _OFFICE_HEIGHT), Look("concrete", 1.4))
    b.box((8.0, 7.44, 1.2), (0.40, 0.02, 0.56), DARK, front=Look("poster:61", None))
    b.box((8.0, 7.96, 1.2), (0.40, 0.02, 0.56), DARK, np.pi, front=Look("poster:62", None))
    b.table((8.0, 6.75), 0.0)
    b.table((8.0, 8.5), 0.0)
    for at in ((0.5, 0.5), (15.5, 0.5), (15.5, 10.5), (0.5, 10.5), (8.0, 2.2), (6.6, 10.6)):
        b.plant(at, 1.2 + 0.3 * float(b.rng.uniform()))


ROOM_WALK = Walk(
    way=np.array(
        [
            [2.6, 1.3, 1.50],
            [3.9, 1.9, 1.55],
            [4.4, 2.9, 1.50],
            [3.6, 3.6, 1.45],
            [2.6, 3.5, 1.50],
            [1.9, 3.2, 1.55],
            [2.2, 2.3, 1.50],
        ]
    ),
    targets=np.array(
        [
            [0.3, 3.2, 1.1],
            [1.2, 4.9, 1.1],
            [3.0, 4.9, 1.2],
            [5.6, 4.4, 1.0],
            [5.9, 2.2, 1.0],
            [4.8, 0.4, 0.9],
            [2.6, 0.1, 0.9],
        ]
    ),
)


def build_room(seed: int) -> Scene:
    """Return a living room of 6 x 5 x 3 m with a desk corner."""
    b = RoomBuilder(seed)
    size, height = (6.0, 5.0), 3.0
    b.floor_and_ceiling((0, 0), size, height, Look("parquet", 1.9), Look("plaster", 2.9, detail=0.06))
    west, north, east, south = sides_of(size)
    b.wall(*west, height, BRICK)
    b.wall(*north, height, Look("wallpaper", 2.1, detail=0.05))
    b.wall(*east, height, PLASTER.tinted(0.92, 0.97, 1.0))
    b.wall(*south, height, PLASTER.tinted(1.0, 0.96, 0.88))
    for start, end in (west, north, east, south):
        b.skirting(start, end, 0.09, 0.02, Look("wood", 1.3))
    b.rectangle((1.6, 1.3, 0.008), (2.4, 0, 0), (0, 1.7, 0), Look("rug", 2.4, detail=0.2), edges=True)

    b.hang(west, 1.25, 1.25, (0.9, 1.15), Look("painting:1", None))
    b.hang(west, 2.75, 1.30, (0.7, 0.95), Look("poster:1", None))
    b.hang(west, 3.85, 1.45, (0.55, 0.75), Look("poster:2", None))
    b.hang(north, 1.5, 1.0, (1.6, 1.35), Look("window:1", None, emission=0.8), 0.06, Look("white", 1.0))
    b.hang(north, 3.3, 1.35, (1.0, 0.75), Look("painting:2", None))
    b.hang(east, 1.05, 1.25, (1.4, 0.95), Look("whiteboard:1", None), 0.03)
    b.hang(east, 3.9, 0.0, (0.95, 2.05), Look("door:1", None), 0.05, Look("wood", 1.0))
    b.hang(south, 1.3, 1.2, (1.2, 0.9), Look("board:1", None), 0.03)
    b.hang(south, 3.0, 1.35, (0.6, 0.85), Look("poster:3", None))
    b.hang(south, 5.1, 1.40, (0.8, 0.6), Look("painting:3", None))

    b.desk((4.6, 0.55), np.pi, 1)
    b.chair((4.55, 1.25), np.pi + 2.7)
    b.shelf((4.6, 4.80), 0.0, 1.3, 2.1, 0)
    b.shelf((5.80, 2.55), -0.5 * np.pi, 0.9, 1.25, 3)
    b.sofa((0.60, 2.1), 0.5 * np.pi, (0.30, 0.10, 0.09))
    b.table((2.0, 2.05), 0.5 * np.pi)
    b.cabinet((2.4, 4.72), 0.0)
    b.cabinet((1.5, 0.30), np.pi, (1.2, 0.45, 0.75), "books:7")
    b.plant((0.45, 4.55))
    b.plant((5.55, 0.45), 1.0)
    b.cylinder((3.3, 0.28, 0), 0.16, 0.36, Look("metal", 0.5, tint=(0.5, 0.55, 0.6)))
    b.box(
        (3.45, 4.62, 0), (0.45, 0.40, 0.35), Look("wood", 0.8, tint=(1.0, 0.85, 0.6)), 0.2, top=Look("poster:5", None)
    )
    b.box((3.47, 4.64, 0.35), (0.32, 0.30, 0.25), Look("board:3", None), -0.2)
    b.lamp_panel(1.6, 2.4, height, power=9.0)
    b.lamp_panel(4.3, 2.6, height, power=9.0)
    return finish(b, "room", ambient=0.30, exposure=0.62, texel=0.08)


_HALL_SIZE = (36.0, 22.0)
_HALL_HEIGHT = 8.0
_CONCRETE = Look("concrete", 2.6, tint=(1.25, 1.22, 1.18), detail=0.10)

HALL_WALK = Walk(
    way=np.array(
        [
            [6.0, 5.0, 1.60],
            [14.0, 4.2, 1.55],
            [22.0, 5.2, 1.60],
            [30.5, 5.0, 1.60],
            [31.5, 11.0, 1.55],
            [29.5, 15.2, 1.60],
            [21.0, 14.2, 1.60],
            [18.0, 10.6, 1.60],
            [14.0, 14.3, 1.60],
            [6.0, 14.6, 1.55],
            [4.6, 10.0, 1.60],
        ]
    ),
    speed=1.0,
    corner=0.9,
    turn=0.9,
    glance=0.5,
    pitch=-0.03,
)


def build_hall(seed: int) -> Scene:
    """Build two rows of columns, a gallery on the north side, windows high up, and islands of seats and kiosks."""
    b = RoomBuilder(seed)
    floor, ceiling = Look("terrazzo", 2.4, detail=0.07), Look("metal", 2.5, detail=0.06)
    b.floor_and_ceiling((0, 0), _HALL_SIZE, _HALL_HEIGHT, floor, ceiling)
    for side, (start, end) in enumerate(sides_of(_HALL_SIZE)):
        b.wall(start, end, _HALL_HEIGHT, BRICK if side == 2 else _CONCRETE)
        _dress_hall(b, start, end, b.skirting(start, end, 0.15, 0.02), side)
    for x in np.arange(6.0, 31.0, 6.0):
        for y in (7.6, 16.6):
            b.cylinder((x, y, 0), 0.38, _HALL_HEIGHT, _CONCRETE)
            b.cylinder((x, y, 0), 0.50, 0.35, Look("terrazzo", 1.2))
        b.beam((x, 0, 7.5), (x, _HALL_SIZE[1], 7.5), (0.35, 0.6), METAL)
    _gallery(b)
    _islands(b)
    for x in np.arange(3.0, 36.0, 6.0):
        for y in (4.0, 11.0, 18.0):
            b.lamp_panel(float(x), y, _HALL_HEIGHT, (1.8, 1.8), power=34.0, reach=14.0)
    return finish(b, "hall", ambient=0.36, exposure=0.62, texel=0.30)


def _dress_hall(b: RoomBuilder, start: Vector, end: Vector, length: float, side: int) -> None:
    """Add high windows, banners, and doors and posters at eye level."""
    number = 20 * side
    for along in np.arange(3.0, length - 1.5, 6.0):
        look = Look(f"window:{number % 4}", None, emission=0.9)
        b.hang((start, end), float(along), 4.6, (2.6, 2.8), look, 0.06, METAL)
        banner = Look(f"poster:{40 + number % 6}", None)
        if side != 1:
            b.hang((start, end), float(along) + 3.0, 3.6, (1.3, 3.2), banner, 0.03)
        number += 1
    along = 1.8
    while along < length - 1.2:
        kind = b.rng.choice(["door", "poster", "painting", "board", "sign"])
        look = Look(f"{kind}:{int(b.rng.integers(0, 5))}", None)
        if kind == "door":
            b.hang((start, end), along, 0.0, (1.0, 2.1), look, 0.06, WOOD)
        else:
            size = (0.5, 0.35) if kind == "sign" else (1.2, 1.5)
            b.hang((start, end), along, 1.1 if kind != "sign" else 1.7, size, look, 0.03)
        along += float(b.rng.uniform(2.0, 3.4))


def _gallery(b: RoomBuilder) -> None:
    """Add a slab at 3.6 m along the north side with its railing."""
    sx, sy = _HALL_SIZE
    b.box((0.5 * sx, sy - 2.0, 3.5), (sx, 4.0, 0.35), _CONCRETE, top=Look("terrazzo", 2.4))
    b.railing((0.1, sy - 3.9, 3.85), (sx - 0.1, sy - 3.9, 3.85), 1.1, METAL, 1.5)


def _islands(b: RoomBuilder) -> None:
    for index, (x, y) in enumerate(((10.0, 9.6), (25.5, 9.2), (17.8, 6.9), (24.0, 17.6), (9.0, 18.5), (33.5, 17.5))):
        b.kiosk((x, y), 0.3 * index, 50 + 2 * index % 8)
    for index, x in enumerate((9.0, 15.0, 21.0, 27.0)):
        b.bench((x, 1.2), np.pi)
        b.bench((x + 1.0, 17.0), 0.0)
        b.plant((x + 2.0, 1.0), 1.6 + 0.1 * index)
    for x, y, yaw in ((12.4, 11.4, 0.5), (22.6, 11.2, -0.7), (26.5, 11.8, 2.4)):
        b.sofa((x, y), yaw, (0.35, 0.12, 0.10), 2.2)
        b.plant((x + 1.6, y + 0.6), 1.5)
    b.box((1.8, 16.0, 0), (0.9, 4.0, 1.1), WOOD, top=Look("terrazzo", 1.5))
    b.box((2.28, 16.0, 0.2), (3.2, 0.02, 0.7), DARK, 0.5 * np.pi, front=Look("painting:9", None))
