"""What rooms are made of: floors, walls, and furniture built of boxes and cylinders at a place and a heading.

`at` is (x, y) or (x, y, z) of the middle of the piece on the floor; `yaw` turns it about the vertical; its front is
local -y. Walls are listed clockwise seen from above, so that they face inwards. All sizes in metres, z up.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from vggtgeo.simulation.shapes import Look, SceneBuilder, Vector

Colour = tuple[float, float, float]
WOOD = Look("wood", 1.1)
METAL = Look("metal", 0.9, tint=(0.55, 0.55, 0.56))
DARK = Look("fabric", 0.8, tint=(0.05, 0.05, 0.06))
WHITE = Look("white", 1.0, detail=0.015)
PLASTER = Look("plaster", 2.3, detail=0.055)
BRICK = Look("brick", 1.7)


class Place:
    """A local frame on the floor; turns local offsets into world positions."""

    def __init__(self, at: Vector, yaw: float) -> None:
        self.at = np.array([*at, 0.0][:3], float)
        self.yaw = yaw
        self.turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])

    def __call__(self, x: float, y: float, z: float = 0.0) -> np.ndarray:
        return self.at + self.turn @ np.array([x, y, z])


def sides_of(size: tuple[float, float]) -> list[tuple[Vector, Vector]]:
    """Return start and end of the four walls of a room from (0, 0) to `size`: west, north, east, south."""
    sx, sy = size
    corners = [(0.0, 0.0), (0.0, sy), (sx, sy), (sx, 0.0), (0.0, 0.0)]
    return list(pairwise(corners))


class RoomBuilder(SceneBuilder):
    """Collects rooms and furniture: `at` is the middle of a piece on the floor, (x, y) or (x, y, z)."""

    def floor_and_ceiling(self, low: Vector, high: Vector, height: float, floor: Look, ceiling: Look) -> None:
        """Add floor at z = 0 facing up, ceiling at `height` facing down, over the rectangle low .. high (x, y)."""
        dx, dy = high[0] - low[0], high[1] - low[1]
        self.rectangle((*low, 0.0), (dx, 0, 0), (0, dy, 0), floor)
        self.rectangle((low[0], high[1], height), (dx, 0, 0), (0, -dy, 0), ceiling)

    def wall(
        self, start: Vector, end: Vector, height: float, look: Look, base: float = 0.0, edges: bool = True
    ) -> None:
        """Add a wall from `start` to `end` (x, y); it faces the right-hand side of that way."""
        (x0, y0), (x1, y1) = start, end
        self.rectangle((x0, y0, base), (x1 - x0, y1 - y0, 0), (0, 0, height), look, edges=edges)

    def skirting(
        self, start: Vector, end: Vector, height: float, depth: float, look: Look = DARK, base: float = 0.0
    ) -> float:
        """Add a skirting board along a wall; return the length of the wall."""
        length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        self.hang((start, end), 0.5 * length, base, (length, height), look, depth, look)
        return length

    def hang(
        self,
        wall: tuple[Vector, Vector],
        along: float,
        base: float,
        size: tuple[float, float],
        look: Look,
        depth: float = 0.025,
        frame: Look = DARK,
    ) -> None:
        """Add a flat thing of `size` (width, height) on a wall, its middle `along` metres from its start."""
        way = np.subtract(wall[1], wall[0])
        yaw = float(np.arctan2(way[1], way[0]))
        place = Place(wall[0], yaw)
        centre = place(along, -0.5 * depth, base)
        self.box(centre, (size[0], depth, size[1]), frame, yaw, front=look, shadow=depth > 0.05)

    def desk(self, at: Vector, yaw: float, variant: int = 0) -> None:
        """Add a desk with a monitor, keyboard, mug, papers and a pile of books."""
        p, width, depth, rng = Place(at, yaw), 1.5, 0.75, self.rng
        self.box(p(0, 0, 0.70), (width, depth, 0.04), WOOD, yaw)
        for x in (-0.46 * width, 0.46 * width):
            for y in (-0.42 * depth, 0.42 * depth):
                self.box(p(x, y), (0.05, 0.05, 0.70), METAL, yaw)
        x = float(rng.uniform(-0.2, 0.2))
        self.box(p(x, 0.18, 0.74), (0.24, 0.18, 0.02), DARK, yaw)
        self.box(p(x, 0.20, 0.76), (0.05, 0.04, 0.14), DARK, yaw)
        self.box(p(x, 0.18, 0.84), (0.56, 0.04, 0.34), DARK, yaw, front=Look(f"screen:{variant}", None, emission=0.45))
        self.box(p(x, -0.16, 0.74), (0.44, 0.15, 0.02), Look("board:9", None, tint=(0.35, 0.35, 0.38)), yaw)
        self.cylinder(p(x + 0.42, -0.05, 0.74), 0.042, 0.10, Look("fabric", 0.4, tint=(0.75, 0.22, 0.16)))
        self.stack_of_books(p(-0.38 * width, 0.12, 0.74), yaw, int(rng.integers(2, 6)))
        self.box(p(0.36 * width, 0.16, 0.74), (0.21, 0.30, 0.012), Look(f"poster:{variant + 20}", None), yaw + 0.3)

    def stack_of_books(self, at: Vector, yaw: float, count: int) -> None:
        """Add `count` books of random size and cover, on top of each other."""
        base = np.array([*at, 0.0][:3], float)
        for _ in range(count):
            width, depth, height = self.rng.uniform([0.15, 0.20, 0.02], [0.22, 0.28, 0.05])
            red, green, blue = self.rng.uniform(0.1, 0.9, 3).tolist()
            tint = (red, green, blue)
            cover = Look(f"poster:{int(self.rng.integers(30, 34))}", None, tint=tint)
            self.box(
                base,
                (width, depth, height),
                Look("fabric", 0.3, tint=tint),
                yaw + self.rng.uniform(-0.3, 0.3),
                top=cover,
            )
            base = base + [0, 0, height]

    def chair(self, at: Vector, yaw: float, tint: Colour = (0.10, 0.16, 0.34)) -> None:
        """Add an office chair; the sitter looks along local -y."""
        p, cloth = Place(at, yaw), Look("fabric", 0.5, tint=tint)
        self.cylinder(p(0, 0, 0), 0.27, 0.05, DARK)
        self.cylinder(p(0, 0, 0.05), 0.03, 0.38, METAL)
        self.box(p(0, 0, 0.43), (0.48, 0.46, 0.08), cloth, yaw)
        self.box(p(0, 0.22, 0.55), (0.44, 0.06, 0.48), cloth, yaw)
        self.box(p(0, 0.25, 0.45), (0.08, 0.03, 0.30), DARK, yaw)

    def shelf(self, at: Vector, yaw: float, width: float = 1.2, height: float = 2.0, variant: int = 0) -> None:
        """Add an open bookcase: boards, a back, and rows of books a few centimetres behind the front."""
        p, depth, board = Place(at, yaw), 0.32, 0.025
        self.box(p(0, 0.5 * depth - 0.01), (width, 0.02, height), WOOD, yaw)
        for x in (-0.5 * width, 0.5 * width):
            self.box(p(x, 0), (board, depth, height), WOOD, yaw)
        rows = max(2, round(height / 0.40))
        step = (height - board) / rows
        for row in range(rows + 1):
            self.box(p(0, 0, row * step), (width, depth, board), WOOD, yaw)
        for row in range(rows):
            left = -0.5 * width + board
            while left < 0.5 * width - 0.25:
                span = min(float(self.rng.uniform(0.25, 0.6)), 0.5 * width - board - left)
                tall = step - board - float(self.rng.uniform(0.03, 0.12))
                deep = float(self.rng.uniform(0.16, 0.24))
                look = Look(f"books:{variant + int(self.rng.integers(0, 3))}", None)
                centre = p(left + 0.5 * span, 0.14 - 0.5 * deep, row * step + board)
                self.box(
                    centre,
                    (span, deep, tall),
                    Look("fabric", 0.3, tint=(0.5, 0.45, 0.4)),
                    yaw,
                    front=look,
                    shadow=False,
                )
                left += span + float(self.rng.uniform(0.02, 0.12))

    def sofa(self, at: Vector, yaw: float, tint: Colour = (0.20, 0.30, 0.26), width: float = 1.9) -> None:
        """Add a sofa with two cushions."""
        p, cloth = Place(at, yaw), Look("fabric", 0.7, tint=tint, detail=0.2)
        self.box(p(0, 0, 0.08), (width, 0.85, 0.30), cloth, yaw)
        self.box(p(0, 0.34, 0.38), (width, 0.18, 0.42), cloth, yaw)
        for x in (-0.5 * width + 0.09, 0.5 * width - 0.09):
            self.box(p(x, -0.02, 0.38), (0.18, 0.80, 0.20), cloth, yaw)
        for x in (-0.24 * width, 0.24 * width):
            self.box(p(x, -0.10, 0.38), (0.40 * width, 0.62, 0.10), cloth.tinted(*(1.25 * c for c in tint)), yaw)
        cushion = Look(f"rug:{int(10 * width)}", 0.45)
        self.box(p(-0.28 * width, 0.16, 0.48), (0.40, 0.12, 0.34), cushion, yaw + 0.15)

    def table(self, at: Vector, yaw: float, size: Vector = (1.1, 0.6, 0.45)) -> None:
        """Add a low table with books and a tin."""
        p, (width, depth, height) = Place(at, yaw), size
        self.box(p(0, 0, height - 0.04), (width, depth, 0.04), WOOD.tinted(0.7, 0.6, 0.5), yaw)
        for x in (-0.44 * width, 0.44 * width):
            for y in (-0.40 * depth, 0.40 * depth):
                self.box(p(x, y), (0.06, 0.06, height - 0.04), WOOD.tinted(0.5, 0.42, 0.36), yaw)
        self.stack_of_books(p(0.2 * width, 0.05, height), yaw, 3)
        self.cylinder(p(-0.25 * width, 0, height), 0.06, 0.16, Look("rug:3", 0.2))

    def cabinet(self, at: Vector, yaw: float, size: Vector = (0.9, 0.45, 1.1), front: str = "door:8") -> None:
        """Add a closed cabinet with things on top; `front` is the texture of its doors."""
        p = Place(at, yaw)
        self.box(p(0, 0), size, WOOD, yaw, front=Look(front, None))
        self.cylinder(p(-0.2, 0, size[2]), 0.07, 0.18, Look("rug:4", 0.25))
        self.stack_of_books(p(0.2, 0, size[2]), yaw, 3)

    def plant(self, at: Vector, height: float = 1.3) -> None:
        """Add a pot with a stem and tiers of leaves."""
        p = Place(at, 0.0)
        self.cylinder(p(0, 0), 0.17, 0.34, Look("brick", 1.0, tint=(1.0, 0.7, 0.6)))
        self.cylinder(p(0, 0, 0.34), 0.025, height - 0.5, WOOD.tinted(0.4, 0.3, 0.2))
        leaf = Look("carpet", 0.5, tint=(0.55, 1.1, 0.32), detail=0.35)
        for tier in range(9):
            angle, rise = 2.4 * tier, 0.5 + 0.09 * tier * height
            reach = 0.20 - 0.012 * tier
            centre = p(reach * np.cos(angle), reach * np.sin(angle), rise)
            self.box(centre, (0.34 - 0.02 * tier, 0.12, 0.02), leaf, angle, edges=False)

    def lamp_panel(
        self,
        x: float,
        y: float,
        z: float,
        size: tuple[float, float] = (1.2, 0.6),
        power: float = 3.2,
        reach: float = 9.0,
    ) -> None:
        """Add a ceiling light with its glowing panel, 4 cm below the ceiling at height `z`."""
        low = np.array([x - 0.5 * size[0], y + 0.5 * size[1], z - 0.04])
        self.rectangle(low, (size[0], 0, 0), (0, -size[1], 0), Look("lamp", None, detail=0.0, emission=1.6), edges=True)
        self.light((x, y, z - 0.08), size, power, reach)

    def beam(self, start: Vector, end: Vector, size: tuple[float, float], look: Look) -> None:
        """Add a straight bar from `start` to `end` in any direction, of `size` (width, height); casts no shadow."""
        low, way = np.asarray(start, float), np.subtract(end, start)
        side = np.cross(way, [0.0, 0.0, 1.0] if abs(way[2]) < 0.9 * np.linalg.norm(way) else [1.0, 0.0, 0.0])
        side *= 0.5 * size[0] / np.linalg.norm(side)
        up = np.cross(side, way)
        up *= 0.5 * size[1] / np.linalg.norm(up)
        for across, out in ((side, up), (up, -side), (-side, -up), (-up, side)):
            self.rectangle(low - across + out, 2 * across, way, look)
        for across, out in ((side, up), (side, -up), (-side, up), (-side, -up)):
            self.edges.append(np.stack([low + across + out, low + way + across + out]))

    def railing(self, start: Vector, end: Vector, height: float, look: Look, spacing: float = 0.9) -> None:
        """Add posts and two rails along start -> end (x, y, z); the rails follow a slope."""
        low, high = np.asarray(start, float), np.asarray(end, float)
        for share in np.linspace(0, 1, max(2, round(float(np.linalg.norm(high - low)) / spacing) + 1)):
            self.box(low + share * (high - low), (0.04, 0.04, height), look, edges=False, shadow=False)
        for level in (0.55 * height, height):
            self.beam(low + [0, 0, level], high + [0, 0, level], (0.05, 0.04), look)

    def bench(self, at: Vector, yaw: float) -> None:
        """Add a wooden bench on two blocks of concrete."""
        p = Place(at, yaw)
        for x in (-0.6, 0.6):
            self.box(p(x, 0), (0.15, 0.42, 0.40), Look("concrete", 0.9), yaw)
        for y in (-0.16, 0.0, 0.16):
            self.box(p(0, y, 0.40), (1.8, 0.13, 0.05), WOOD, yaw)

    def kiosk(self, at: Vector, yaw: float, variant: int) -> None:
        """Add an advertising column of 0.9 x 0.9 x 2.2 m with four posters."""
        p = Place(at, yaw)
        self.box(p(0, 0), (0.9, 0.9, 2.2), METAL, yaw)
        for side in range(4):
            turn = yaw + 0.5 * np.pi * side
            centre = Place(p(0, 0), turn)(0, -0.46, 0.55)
            poster = Look(f"poster:{variant + side}", None, emission=0.15)
            self.box(centre, (0.76, 0.02, 1.15), DARK, turn, front=poster, shadow=False)
