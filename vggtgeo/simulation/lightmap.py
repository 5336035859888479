"""Soft light on every surface, computed once a scene: lamps with shadows, and darkening in corners.

The light that arrives does not depend on the camera, so the same point has the same colour in every frame (up to
exposure and noise): what a photometric test needs. Irradiance is sampled on a grid of a few texels a surface and
looked up bilinearly.

    direct   = sum over lamps, over points of each lamp: power cos(theta) cos(theta_lamp) / (r^2 + 0.5) * unshadowed
    ambient  = base * (1 - 0.55 * share of a cosine-weighted hemisphere that solid boxes block within 0.8 m)
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.simulation.atlas import look_up, pack_shelves
from vggtgeo.simulation.shapes import Blockers, Surfaces

_WIDTH = 2048
_AMBIENT_REACH, _AMBIENT_RAYS = 0.8, 12
_BATCH = 60000  # segments times boxes tested at once: small enough for the cache
_CELL = 1.0  # metres: points in a cube are tested together against the boxes in their way
_LAMP_CELLS = 3  # a lamp is sampled once in each of 3 x 3 cells


@dataclass(frozen=True)
class Lightmap:
    """image: float32 [H, W], irradiance. corner: float32 [P, 2], texel of (s, t) = 0. density: [P, 2], texels a m."""

    image: np.ndarray
    corner: np.ndarray
    density: np.ndarray

    def sample(self, which: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the irradiance float32 [n] of surfaces `which` [n] at (s, t) [n], metres."""
        x = self.corner[:, 0][which] + s * self.density[:, 0][which]
        y = self.corner[:, 1][which] + t * self.density[:, 1][which]
        return look_up(self.image, x, y)


def bake(
    surfaces: Surfaces, blockers: Blockers, lights: list[tuple], ambient: float, texel: float, seed: int
) -> Lightmap:
    """Return the lightmap of a scene with about one sample each `texel` metres."""
    rng = np.random.default_rng([seed, 11])
    counts = np.clip(np.ceil(surfaces.extent / texel).astype(int) + 1, 2, _WIDTH)
    corner, height = pack_shelves(counts, _WIDTH)
    image = np.zeros((height, _WIDTH), np.float32)
    which, s, t, sizes = _texels(surfaces, counts)
    points, normals = surfaces.points(which, s, t)
    points += 0.012 * normals
    starts = np.concatenate([[0], np.cumsum(sizes)])
    samples = _Samples(points, normals, blockers)
    light = ambient * samples.openness(rng)
    for lamp in lights:
        light += samples.lit_by(lamp, rng)
    for row, (width, rows) in enumerate(counts):
        grid = light[starts[row] : starts[row + 1]].reshape(rows, width)
        smooth = cv2.GaussianBlur(grid, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE)
        x, y = corner[row]
        image[y : y + rows, x : x + width] = smooth
    density = (counts - 1) / surfaces.extent
    return Lightmap(image, corner.astype(np.float32), density.astype(np.float32))


def _texels(surfaces: Surfaces, counts: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return (surface, s, t) of every texel, and how many each surface has; outer texels lie 1 cm inside the border."""
    which, s, t = [], [], []
    for row, (width, height) in enumerate(counts):
        margin = np.minimum(0.01, 0.1 * surfaces.extent[row])
        across = np.clip(np.linspace(0, surfaces.extent[row, 0], width), margin[0], surfaces.extent[row, 0] - margin[0])
        upward = np.clip(
            np.linspace(0, surfaces.extent[row, 1], height), margin[1], surfaces.extent[row, 1] - margin[1]
        )
        grid_t, grid_s = np.meshgrid(upward, across, indexing="ij")
        which.append(np.full(grid_s.size, row))
        s.append(grid_s.ravel())
        t.append(grid_t.ravel())
    return np.concatenate(which), np.concatenate(s), np.concatenate(t), counts.prod(axis=1)


@dataclass(frozen=True)
class _Samples:
    """Points [n, 3] on surfaces with their normals."""

    points: np.ndarray
    normals: np.ndarray
    blockers: Blockers

    def openness(self, rng: np.random.Generator) -> np.ndarray:
        direction = rng.standard_normal((len(self.points), _AMBIENT_RAYS, 3), dtype=np.float32)
        direction /= np.maximum(np.linalg.norm(direction, axis=2, keepdims=True), 1e-6)
        direction += self.normals[:, None]  # a uniform sphere on the tip of the normal: cosine-weighted directions
        direction /= np.maximum(np.linalg.norm(direction, axis=2, keepdims=True), 1e-6)
        blocked = _shadowed(self.points, _AMBIENT_REACH * direction, self.blockers)
        return 1.0 - 0.55 * blocked.mean(axis=1)

    def lit_by(self, lamp: tuple, rng: np.random.Generator) -> np.ndarray:
        centre, size, power, reach = lamp
        light = np.zeros(len(self.points))
        towards = centre - self.points
        faces = np.einsum("nk,nk->n", towards, self.normals) > -0.5
        near = np.nonzero((np.sum(towards**2, axis=1) < reach**2) & faces)[0]
        to_lamp = np.repeat(towards[near][:, None], _LAMP_CELLS**2, axis=1)
        cells = np.stack(np.divmod(np.arange(_LAMP_CELLS**2), _LAMP_CELLS), axis=1)
        to_lamp[..., :2] += ((cells + rng.uniform(0, 1, (len(near), len(cells), 2))) / _LAMP_CELLS - 0.5) * size
        square = np.sum(to_lamp**2, axis=2)
        distance = np.sqrt(square)
        cosine = np.maximum(np.einsum("nk,nsk->ns", self.normals[near], to_lamp), 0) / distance
        downward = np.clip(to_lamp[..., 2] / distance, 0, 1)
        gain = power * cosine * downward * np.clip(1 - (distance / reach) ** 4, 0, 1) / (square + 0.5)
        lit = np.nonzero(gain.max(axis=1, initial=0.0) > 1e-4)[0]
        shadow = _shadowed(self.points[near[lit]], 0.97 * to_lamp[lit], self.blockers)
        light[near[lit]] = (gain[lit] * ~shadow).mean(axis=1)
        return light


def _shadowed(points: np.ndarray, rays: np.ndarray, blockers: Blockers) -> np.ndarray:
    """Return whether the segments points [n, 3] -> points + rays [n, S, 3] meet a box: bool [n, S].

    Points that lie together are tested at once, against the boxes that may be in their way.
    """
    points, rays = points.astype(np.float32), rays.astype(np.float32)
    blocked = np.zeros(rays.shape[:2], bool)
    cells = np.floor(points / _CELL).astype(int)
    order = np.lexsort(cells.T)
    changes = np.flatnonzero(np.any(np.diff(cells[order], axis=0), axis=1)) + 1
    for own in np.split(order, changes):
        at, towards = points[own], rays[own]
        boxes = _in_the_way(at, at[:, None] + towards, blockers)
        batch = max(1, _BATCH // towards[..., 0].size)
        for some in np.split(boxes, np.arange(batch, len(boxes), batch)):
            blocked[own] |= _meets(at, towards, blockers, some)
    return blocked


def _in_the_way(starts: np.ndarray, ends: np.ndarray, blockers: Blockers) -> np.ndarray:
    """Return the boxes that segments from `starts` [n, 3] to `ends` [n, S, 3] may meet, int [B].

    All segments lie in the bounds of their ends, and around the line between the centres of starts and ends, within
    the larger of both radii.
    """
    ends = ends.reshape(-1, 3)
    reach = np.hypot(blockers.half[:, 0], blockers.half[:, 1])
    reach = np.stack([reach, reach, blockers.half[:, 2]], axis=1)
    bottom, top = np.minimum(starts.min(0), ends.min(0)), np.maximum(starts.max(0), ends.max(0))
    inside = np.all((blockers.centre - reach <= top) & (blockers.centre + reach >= bottom), axis=1)
    first, last = starts.mean(0), ends.mean(0)
    radius = max(np.linalg.norm(starts - first, axis=1).max(), np.linalg.norm(ends - last, axis=1).max())
    along, offset = last - first, blockers.centre - first
    share = np.clip(offset @ along / max(along @ along, 1e-9), 0, 1)
    apart = np.linalg.norm(offset - share[:, None] * along, axis=1)
    return np.flatnonzero(inside & (apart <= 1.001 * (radius + np.linalg.norm(blockers.half, axis=1))))


def _meets(points: np.ndarray, rays: np.ndarray, blockers: Blockers, some: np.ndarray) -> np.ndarray:
    """Test segments points [n, 3], rays [n, S, 3] against the boxes `some` [B], slab by slab: bool [n, S].

    The rays are the last axis, which numpy's loops run along.
    """
    yaw = blockers.yaw[some]
    cos, sin = (part.astype(np.float32)[:, None, None] for part in (np.cos(yaw), np.sin(yaw)))
    half = blockers.half[some].astype(np.float32)[:, None, None]
    local = points[None, :, None] - blockers.centre[some].astype(np.float32)[:, None, None]
    px, py, pz = (local[..., k] for k in range(3))
    x, y, z = (np.ascontiguousarray(rays[..., k]) for k in range(3))
    enter, leave = np.float32(1e-4), np.float32(1.0)
    slabs = (cos * px + sin * py, cos * x + sin * y), (cos * py - sin * px, cos * y - sin * x), (pz, z)
    for axis, (position, way) in enumerate(slabs):
        inverse = np.float32(1.0) / np.where(np.abs(way) < 1e-9, np.float32(1e-9), way)
        middle, reach = -position * inverse, half[..., axis] * np.abs(inverse)
        enter = np.maximum(enter, middle - reach)
        leave = np.minimum(leave, middle + reach)
    return np.any(enter < leave, axis=0)
