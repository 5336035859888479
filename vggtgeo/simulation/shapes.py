"""Surfaces of a scene: rectangles, discs and cylinder walls, and the builder that collects them.

The world is in metres, z up. Every surface is parametrised by (s, t) in metres: a rectangle or disc by its two unit
axes from its origin, a cylinder wall by arc length and height. `Surfaces` keeps them as arrays, one row a surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

Vector = Sequence[float] | np.ndarray

RECTANGLE, DISC, CYLINDER = 0, 1, 2
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Look:
    """What a surface looks like.

    texture: name for `decals.paint_texture`. tile: metres of one repetition, None = stretched over the surface.
    tint: colour factor (linear). detail: relative amplitude of the fine structure on top. emission: 0 = lit by the
    lamps only, 1 = as bright as white under full light.
    """

    texture: str
    tile: float | None = 1.7
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    detail: float = 0.12
    emission: float = 0.0

    def tinted(self, red: float, green: float, blue: float) -> Look:
        return replace(self, tint=(red, green, blue))


@dataclass(frozen=True)
class Surfaces:
    """P surfaces. kind: int8 [P]. origin, axis1, axis2, normal: float64 [P, 3]. extent: float64 [P, 2], metres.

    Of a cylinder wall: origin is the centre of its base, `normal` its axis, axis1 and axis2 span the base, extent is
    (circumference, height). corners: float64 [P, 8, 3], points whose convex hull holds the surface.
    """

    kind: np.ndarray
    origin: np.ndarray
    axis1: np.ndarray
    axis2: np.ndarray
    normal: np.ndarray
    extent: np.ndarray
    corners: np.ndarray

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def radius(self) -> np.ndarray:
        """Radius of cylinder walls and discs, metres [P] (meaningless for rectangles)."""
        return np.where(self.kind == CYLINDER, self.extent[:, 0] / (2 * np.pi), 0.5 * self.extent[:, 0])

    def points(self, which: np.ndarray, s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return world points and unit normals [n, 3] of surfaces `which` [n] at (s, t) [n]."""
        origin, axis1, axis2 = self.origin[which], self.axis1[which], self.axis2[which]
        normal = self.normal[which]
        flat = origin + s[:, None] * axis1 + t[:, None] * axis2
        radius = self.radius[which]
        angle = s / np.maximum(radius, 1e-9)
        outward = np.cos(angle)[:, None] * axis1 + np.sin(angle)[:, None] * axis2
        round_ = origin + radius[:, None] * outward + t[:, None] * normal
        bent = (self.kind[which] == CYLINDER)[:, None]
        return np.where(bent, round_, flat), np.where(bent, outward, normal)


@dataclass(frozen=True)
class Blockers:
    """Solid boxes that cast shadows: centre [B, 3], yaw [B], half [B, 3] (metres, radians)."""

    centre: np.ndarray
    yaw: np.ndarray
    half: np.ndarray


@dataclass
class SceneBuilder:
    """Collects surfaces, edges, lights and panes; `scene.finish` makes the immutable scene of them."""

    seed: int
    rows: list[tuple] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)
    edges: list[np.ndarray] = field(default_factory=list)
    boxes: list[tuple] = field(default_factory=list)
    lights: list[tuple] = field(default_factory=list)
    panes: list[tuple] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, 7])

    def rectangle(self, origin: Vector, along: Vector, up: Vector, look: Look, edges: bool = False) -> None:
        """Add a rectangle from `origin` along the vectors `along` and `up` (metres); it faces `along x up`."""
        origin, along, up = (np.asarray(v, float) for v in (origin, along, up))
        self._add(RECTANGLE, origin, along, up, look)
        if edges:
            loop = np.array([origin, origin + along, origin + along + up, origin + up, origin])
            self.edges.extend(np.stack([loop[:-1], loop[1:]], axis=1))

    def pane(self, origin: Vector, along: Vector, up: Vector) -> None:
        """Add a sheet of clear glass: it lets light through and mirrors what is in front of it."""
        origin, along, up = (np.asarray(v, float) for v in (origin, along, up))
        self.panes.append(_rectangle_row(RECTANGLE, origin, along, up))

    def light(self, centre: Vector, size: tuple[float, float], power: float, reach: float = 9.0) -> None:
        """Add a horizontal lamp of `size` metres that shines down; nothing beyond `reach` metres is lit by it."""
        self.lights.append((np.asarray(centre, float), size, power, reach))

    def box(
        self,
        centre: Vector,
        size: Vector,
        look: Look,
        yaw: float = 0.0,
        top: Look | None = None,
        front: Look | None = None,
        edges: bool = True,
        shadow: bool = True,
    ) -> None:
        """Add a box standing on `centre` = (x, y, z of its base); `front` dresses its side towards local -y."""
        base, (dx, dy, dz) = np.asarray(centre, float), size
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
        x, y, z = (turn[:, k] * size[k] for k in range(3))
        low = base - 0.5 * (x + y)
        self.rectangle(low, x, z, front or look)
        self.rectangle(low + x, y, z, look)
        self.rectangle(low + x + y, -x, z, look)
        self.rectangle(low + y, -y, z, look)
        self.rectangle(low + z, x, y, top or look)
        if base[2] > 0.02:
            self.rectangle(low + y, x, -y, look)
        if edges and min(dx, dy, dz) > 0.015:
            self._box_edges(low, x, y, z)
        if shadow:
            self.boxes.append((base + 0.5 * z, yaw, 0.5 * np.asarray(size, float)))

    def cylinder(self, base: Vector, radius: float, height: float, look: Look) -> None:
        """Add an upright closed cylinder standing on `base`."""
        base = np.asarray(base, float)
        low, high = base - [radius, radius, 0], base + [radius, radius, height]
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        row = (CYLINDER, base, np.eye(3)[0], np.eye(3)[1], UP, (2 * np.pi * radius, height), corners)
        self.rows.append(row)
        self.looks.append(look)
        top = base + [0, 0, height] - [radius, radius, 0]
        self._add(DISC, top, np.array([2 * radius, 0, 0]), np.array([0, 2 * radius, 0]), look)
        self.boxes.append((base + [0, 0, 0.5 * height], 0.0, np.array([0.8 * radius, 0.8 * radius, 0.5 * height])))

    def _add(self, kind: int, origin: np.ndarray, along: np.ndarray, up: np.ndarray, look: Look) -> None:
        self.rows.append(_rectangle_row(kind, origin, along, up))
        self.looks.append(look)

    def _box_edges(self, low: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> None:
        for a, b, c in ((x, y, z), (y, z, x), (z, x, y)):
            for shift in (0 * b, b, c, b + c):
                self.edges.append(np.stack([low + shift, low + shift + a]))


def _rectangle_row(kind: int, origin: np.ndarray, along: np.ndarray, up: np.ndarray) -> tuple:
    extent = (np.linalg.norm(along), np.linalg.norm(up))
    axis1, axis2 = along / extent[0], up / extent[1]
    loop = np.array([origin, origin + along, origin + along + up, origin + up])
    return kind, origin, axis1, axis2, np.cross(axis1, axis2), extent, np.concatenate([loop, loop])


def stack_surfaces(rows: list[tuple]) -> Surfaces:
    """Return rows of a builder as arrays."""
    if not rows:
        none = np.zeros((0, 3))
        return Surfaces(np.zeros(0, np.int8), none, none, none, none, np.zeros((0, 2)), np.zeros((0, 8, 3)))
    columns = [np.array(column, float) for column in zip(*rows, strict=True)]
    return Surfaces(columns[0].astype(np.int8), *columns[1:])


def stack_blockers(boxes: list[tuple]) -> Blockers:
    """Return the boxes of a builder as arrays."""
    centre, yaw, half = zip(*boxes, strict=True) if boxes else ((), (), ())
    return Blockers(np.reshape(centre, (-1, 3)), np.array(yaw, float), np.reshape(half, (-1, 3)))
