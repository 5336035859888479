"""The built-in `room`: 6 x 5 x 3 m, furnished."""

from __future__ import annotations

import numpy as np

from vggtgeo.simulation.furniture import BRICK, PLASTER, RoomBuilder, sides_of
from vggtgeo.simulation.scene import Scene, finish
from vggtgeo.simulation.shapes import Look
from vggtgeo.simulation.trajectories import Walk

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

    b.hang(*west, 1.25, 1.25, (0.9, 1.15), Look("painting:1", None))
    b.hang(*west, 2.75, 1.30, (0.7, 0.95), Look("poster:1", None))
    b.hang(*west, 3.85, 1.45, (0.55, 0.75), Look("poster:2", None))
    b.hang(*north, 1.5, 1.0, (1.6, 1.35), Look("window:1", None, emission=0.8), 0.06, Look("white", 1.0))
    b.hang(*north, 3.3, 1.35, (1.0, 0.75), Look("painting:2", None))
    b.hang(*east, 1.05, 1.25, (1.4, 0.95), Look("whiteboard:1", None), 0.03)
    b.hang(*east, 3.9, 0.0, (0.95, 2.05), Look("door:1", None), 0.05, Look("wood", 1.0))
    b.hang(*south, 1.3, 1.2, (1.2, 0.9), Look("board:1", None), 0.03)
    b.hang(*south, 3.0, 1.35, (0.6, 0.85), Look("poster:3", None))
    b.hang(*south, 5.1, 1.40, (0.8, 0.6), Look("painting:3", None))

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
        (3.45, 4.62, 0),
        (0.45, 0.40, 0.35),
        Look("wood", 0.8, tint=(1.0, 0.85, 0.6)),
        0.2,
        top=Look("poster:5", None),
    )
    b.box((3.47, 4.64, 0.35), (0.32, 0.30, 0.25), Look("board:3", None), -0.2)
    b.lamp_panel(1.6, 2.4, height, power=9.0)
    b.lamp_panel(4.3, 2.6, height, power=9.0)
    return finish(b, "room", ambient=0.30, exposure=0.62, texel=0.08)
