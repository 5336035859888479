"""Exact knowledge about the images of a synthetic sequence, for the stubs of the five roles: points, matches, edges,
strength of texture.

Roles receive images, not frame numbers. So the oracle is itself a `Sequence`, and remembers a fingerprint of each
image.
"""

from __future__ import annotations

import zlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.geometry import pinhole
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.simulation.raster import EMPTY, NEAR, View, encode, inverse_depth_at, view_from
from vggtgeo.simulation.render import Picture
from vggtgeo.simulation.sequence import SyntheticSequence

_HALF_STRENGTH = 6.0  # grey levels a pixel of gradient in the weaker direction that count as strength 0.5
_DEPTH_TOLERANCE = 0.01  # relative; what is nearer by more hides a point
_SHORTEST = 15.0  # pixels of a visible part of an edge
_SAMPLE = 3.0  # pixels between samples along an edge
_KEPT_FRAMES = 14  # about 10 MB each at 640 x 480, 3 MB at 320 x 240


@dataclass(frozen=True, eq=False)
class VisibleEdges:
    """Visible parts of straight 3D edges in one frame.

    pixels: float64 [L, 2, 2] (segment, end, xy). points: float64 [L, 2, 3], world, metres. edge: int [L], row of the
    scene's `edges`; an edge hidden in its middle gives two parts. contrast: float64 [L], mean size of the image
    gradient along the part, grey levels a pixel.
    """

    pixels: np.ndarray
    points: np.ndarray
    edge: np.ndarray
    contrast: np.ndarray


@dataclass(frozen=True, eq=False)
class _KnownFrame:
    sequence: SyntheticSequence
    index: int

    @cached_property
    def picture(self) -> Picture:
        return self.sequence.picture(self.index)

    @cached_property
    def view(self) -> View:
        return view_from(self.sequence.scene.surfaces, self.sequence.pose(self.index))

    def points_at(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return world points float64 [n, 3] that `pixels` [n, 2] show, and whether there is a surface, bool [n].

        Exact at sub-pixel places: the ray meets the surface that the nearest pixel's centre sees.
        """
        pose, surface = self.sequence.pose(self.index), pinhole.at_pixels(self.picture.surface, pixels)
        there = surface != EMPTY
        rays = pinhole.rays(np.asarray(pixels, np.float64), self.sequence.camera.intrinsics)
        with np.errstate(divide="ignore"):
            depth = 1.0 / inverse_depth_at(self.view, np.where(there, surface, 0), rays[:, 0], rays[:, 1])
        points = depth[:, None] * rays
        return (points - pose[:3, 3]) @ pose[:3, :3], there & np.isfinite(depth) & (depth > 0)

    @cached_property
    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """Return that of the noise-free image along x and y, float32 [H, W], grey levels a pixel."""
        grey = cv2.cvtColor(encode(self.picture.light), cv2.COLOR_RGB2GRAY).astype(np.float32)
        return cv2.Scharr(grey, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(grey, cv2.CV_32F, 0, 1) / 32

    @cached_property
    def texture(self) -> np.ndarray:
        """Return how well each pixel can be localised from texture alone: float32 [H, W] in [0, 1).

        g / (g + 6), g the root of the smaller eigenvalue of the structure tensor (Gaussian, 2 px): straight edges do
        not count, corners and texture do.
        """
        dx, dy = self.gradient
        xx, yy, xy = (cv2.GaussianBlur(product, (0, 0), 2.0) for product in (dx * dx, dy * dy, dx * dy))
        smaller = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
        strength = np.sqrt(np.maximum(smaller, 0.0))
        return np.asarray(strength / (strength + _HALF_STRENGTH), np.float32)

    @cached_property
    def farthest(self) -> np.ndarray:
        """Return the largest depth within a pixel of each pixel, float32 [H, W], metres: what hides nothing nearer."""
        depth = np.nan_to_num(self.picture.depth, nan=np.inf).astype(np.float32)
        return np.asarray(cv2.dilate(depth, np.ones((3, 3), np.uint8)))

    @cached_property
    def edges(self) -> VisibleEdges:
        """Return the visible parts of the scene's edges that are at least `_SHORTEST` pixels long."""
        pose, camera = self.sequence.pose(self.index), self.sequence.camera
        contrast = cv2.dilate(np.hypot(*self.gradient), np.ones((3, 3), np.uint8))
        parts: list[tuple[np.ndarray, np.ndarray, int, float]] = []
        for index, ends in _clipped(self.sequence.scene.edges, pose, camera):
            length = float(np.linalg.norm(ends[1, :2] - ends[0, :2]))
            if length >= _SHORTEST:
                parts += _visible_parts(index, ends, length, pose, camera, (self.farthest, contrast))
        if not parts:
            return VisibleEdges(np.zeros((0, 2, 2)), np.zeros((0, 2, 3)), np.zeros(0, int), np.zeros(0))
        return VisibleEdges(*map(np.array, zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class SimulatedOracle:
    """A `Sequence` with the ground truth of each of its images.

    kept: number of frames whose ground truth is kept in memory; others are rendered again on request.
    """

    sequence: SyntheticSequence
    kept: int = _KEPT_FRAMES
    _given: dict[tuple[int, int], int] = field(default_factory=dict, repr=False)
    _cache: OrderedDict[int, _KnownFrame] = field(default_factory=OrderedDict, repr=False)

    @property
    def name(self) -> str:
        return self.sequence.name

    @property
    def camera(self) -> Camera:
        return self.sequence.camera

    @property
    def has_depth(self) -> bool:
        return self.sequence.has_depth

    @property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy, float64 [4], pixels."""
        return np.array(self.camera.intrinsics)

    def __len__(self) -> int:
        return len(self.sequence)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """Return the sequence's frames; each is known to `index_of` from then on."""
        check_selection(self.name, len(self), start, end, stride)
        for index in range(start, min(len(self), end or len(self)), stride):
            frame = self.sequence.frame(index, self._known(index).picture)
            self._given[_fingerprint(frame.image)] = index
            yield frame

    def ground_truth(self) -> Trajectory:
        return self.sequence.ground_truth()

    def index_of(self, image: np.ndarray) -> int:
        """Return the frame of an image; raise InputError for an image that is not of `frames`."""
        index = self._given.get(_fingerprint(image))
        if index is None:
            raise InputError("`image` is not of the oracle's `frames()`: run the pipeline on the oracle, unchanged")
        return index

    def timestamp(self, index: int) -> float:
        return self.sequence.timestamp(index)

    def pose(self, index: int) -> np.ndarray:
        """Return the true pose, world -> camera, float64 [4, 4]."""
        return self.sequence.pose(index)

    def depth(self, index: int) -> np.ndarray:
        """Return the true depth float64 [H, W], metres, NaN = none."""
        return self._known(index).picture.depth

    def glass(self, index: int) -> np.ndarray:
        """Return pixels seen through glass, bool [H, W]."""
        return self._known(index).picture.glass

    def texture(self, index: int) -> np.ndarray:
        return self._known(index).texture

    def edges(self, index: int) -> VisibleEdges:
        return self._known(index).edges

    def correspond(self, index_i: int, index_j: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where `pixels` [n, 2] of frame i are in frame j, float64 [n, 2], and whether they are seen there,
        bool.
        """
        points, there = self._known(index_i).points_at(pixels)
        pose = self.pose(index_j)
        local = points @ pose[:3, :3].T + pose[:3, 3]
        target = pinhole.project(local, self.camera.intrinsics, NEAR)
        return target, there & is_visible(target, local[:, 2], self._known(index_j).farthest)

    def _known(self, index: int) -> _KnownFrame:
        known = self._cache.pop(index, None) or _KnownFrame(self.sequence, index)
        self._cache[index] = known
        if len(self._cache) > self.kept:
            self._cache.popitem(last=False)
        return known


def _fingerprint(image: np.ndarray) -> tuple[int, int]:
    data = np.ascontiguousarray(image).tobytes()
    return zlib.crc32(data), zlib.adler32(data)


def is_visible(pixels: np.ndarray, depths: np.ndarray, farthest: np.ndarray) -> np.ndarray:
    """Return whether points at `pixels` [n, 2] with depths [n] are inside the picture and not hidden: bool [n].

    farthest: of `_KnownFrame`. A point is hidden if all surfaces within a pixel of it are nearer by over 1 %.
    """
    height, width = farthest.shape
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels >= -0.5) & (pixels <= np.array([width, height]) - 0.5), axis=1) & (depths > NEAR)
    nearby = pinhole.at_pixels(farthest, np.where(inside[:, None], pixels, 0.0))
    return inside & (depths <= nearby * (1 + _DEPTH_TOLERANCE))


def _clipped(edges: np.ndarray, pose: np.ndarray, camera: Camera) -> list[tuple[int, np.ndarray]]:
    """Return edges cut to the picture: (row, [2, 3] = (u, v, inverse depth) of both ends); affine along the segment."""
    local = edges @ pose[:3, :3].T + pose[:3, 3]
    found = []
    for index in np.nonzero((local[..., 2] > NEAR).any(axis=1))[0]:
        a, b = local[index]
        if min(a[2], b[2]) < NEAR:
            cut = a + (NEAR - a[2]) / (b[2] - a[2]) * (b - a)
            a, b = (cut, b) if a[2] < NEAR else (a, cut)
        points = np.stack([a, b])
        ends = np.column_stack([pinhole.project(points, camera.intrinsics), 1.0 / points[:, 2]])
        inside = _cut_to_picture(ends, camera)
        if inside is not None:
            found.append((int(index), inside))
    return found


def _cut_to_picture(ends: np.ndarray, camera: Camera) -> np.ndarray | None:
    start, way = ends[0], ends[1] - ends[0]
    enter, leave = 0.0, 1.0
    for axis, high in ((0, camera.width - 1.0), (1, camera.height - 1.0)):
        if abs(way[axis]) < 1e-9:
            if not 0.0 <= start[axis] <= high:
                return None
            continue
        first, last = sorted(((0.0 - start[axis]) / way[axis], (high - start[axis]) / way[axis]))
        enter, leave = max(enter, first), min(leave, last)
    return np.stack([start + enter * way, start + leave * way]) if enter < leave else None


def _visible_parts(
    index: int, ends: np.ndarray, length: float, pose: np.ndarray, camera: Camera, maps: tuple[np.ndarray, np.ndarray]
) -> list[tuple[np.ndarray, np.ndarray, int, float]]:
    count = max(2, int(length / _SAMPLE) + 1)
    samples = ends[0] + np.linspace(0, 1, count)[:, None] * (ends[1] - ends[0])
    seen = is_visible(samples[:, :2], 1.0 / samples[:, 2], maps[0])
    seen[1:-1] |= seen[:-2] & seen[2:]  # one hidden sample is no gap
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]])))
    parts = []
    for first, last in zip(bounds[::2], bounds[1::2] - 1, strict=True):
        run = samples[[first, last]]
        if np.linalg.norm(run[1, :2] - run[0, :2]) < _SHORTEST:
            continue
        points = (pinhole.rays(run[:, :2], camera.intrinsics) / run[:, 2:] - pose[:3, 3]) @ pose[:3, :3]
        contrast = pinhole.at_pixels(maps[1], samples[first : last + 1, :2])
        parts.append((run[:, :2], points, index, float(contrast.mean())))
    return parts
