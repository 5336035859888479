"""The `hall`: an atrium of 36 x 22 x 8 m with columns, a gallery, banners and high windows. Large and far."""

from __future__ import annotations

import numpy as np

from vggtgeo.simulation.furniture import BRICK, DARK, METAL, WOOD, RoomBuilder, sides_of
from vggtgeo.simulation.scene import Scene, finish
from vggtgeo.simulation.shapes import Look, Vector
from vggtgeo.simulation.trajectories import Walk

_SIZE = (36.0, 22.0)
_HEIGHT = 8.0
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
    b.floor_and_ceiling((0, 0), _SIZE, _HEIGHT, Look("terrazzo", 2.4, detail=0.07), Look("metal", 2.5, detail=0.06))
    for side, (start, end) in enumerate(sides_of(_SIZE)):
        b.wall(start, end, _HEIGHT, BRICK if side == 2 else _CONCRETE)
        _dress(b, start, end, b.skirting(start, end, 0.15, 0.02), side)
    for x in np.arange(6.0, 31.0, 6.0):
        for y in (7.6, 16.6):
            b.cylinder((x, y, 0), 0.38, _HEIGHT, _CONCRETE)
            b.cylinder((x, y, 0), 0.50, 0.35, Look("terrazzo", 1.2))
        b.beam((x, 0, 7.5), (x, _SIZE[1], 7.5), (0.35, 0.6), METAL)
    _gallery(b)
    _islands(b)
    for x in np.arange(3.0, 36.0, 6.0):
        for y in (4.0, 11.0, 18.0):
            b.lamp_panel(float(x), y, _HEIGHT, (1.8, 1.8), power=34.0, reach=14.0)
    return finish(b, "hall", ambient=0.36, exposure=0.62, texel=0.30)


def _dress(b: RoomBuilder, start: Vector, end: Vector, length: float, side: int) -> None:
    """Add high windows, banners, and doors and posters at eye level."""
    number = 20 * side
    for along in np.arange(3.0, length - 1.5, 6.0):
        look = Look(f"window:{number % 4}", None, emission=0.9)
        b.hang(start, end, float(along), 4.6, (2.6, 2.8), look, 0.06, METAL)
        banner = Look(f"poster:{40 + number % 6}", None)
        if side != 1:
            b.hang(start, end, float(along) + 3.0, 3.6, (1.3, 3.2), banner, 0.03)
        number += 1
    along = 1.8
    while along < length - 1.2:
        kind = b.rng.choice(["door", "poster", "painting", "board", "sign"])
        look = Look(f"{kind}:{int(b.rng.integers(0, 5))}", None)
        if kind == "door":
            b.hang(start, end, along, 0.0, (1.0, 2.1), look, 0.06, WOOD)
        else:
            size = (0.5, 0.35) if kind == "sign" else (1.2, 1.5)
            b.hang(start, end, along, 1.1 if kind != "sign" else 1.7, size, look, 0.03)
        along += float(b.rng.uniform(2.0, 3.4))


def _gallery(b: RoomBuilder) -> None:
    """Add a slab at 3.6 m along the north side with its railing."""
    sx, sy = _SIZE
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
