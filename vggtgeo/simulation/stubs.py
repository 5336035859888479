"""Stubs of the five roles: an oracle of a synthetic scene plus a stated error model.

Every number that comes out of them is simulated and has to be called so. Random numbers depend on the seed, the role
and the frames, not on the order of calls.

| role | stub | stands for |
|---|---|---|
| `PointMatcher` | `SimulatedMast3r` | MASt3R |
| `LineDetector` | `SimulatedLetr` | LETR |
| `MetricDepth` | `SimulatedMoge` | MoGe-2 |
| `DenseConfidence` | `SimulatedDino` | DINOv3 |
| `WindowGeometry` | `SimulatedVggt` | VGGT |
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import pinhole
from vggtgeo.models.roles import DepthEstimate, Features, GeometryResult, PointMatches, Segments, WindowGuess
from vggtgeo.simulation.oracle import SimulatedOracle

_WAVES = 24
_FULL_TEXTURE = 0.25
"""Strength from which a region counts as well textured."""


def stream(seed: int, role: str, *indices: int) -> np.random.Generator:
    """Return the random stream of one answer."""
    return np.random.default_rng([seed, zlib.crc32(role.encode()), *indices])


def smooth_field(
    rng: np.random.Generator, shape: tuple[int, int], time: float, cycles: float, memory: float
) -> np.ndarray:
    """Return a Gaussian-like field over a picture that drifts with time, float32 [H, W]: mean 0, variance 1 everywhere.

    f(x, y, t) = sqrt(2 / K) sum_k cos(2 pi (a_k x + b_k y) + c_k t + phase_k), x and y in [0, 1]; a, b normal with
    deviation `cycles` waves a picture, c normal with deviation 1 / `memory` (seconds). Equal streams give one field.
    """
    across, down = rng.normal(0, cycles, (2, _WAVES))
    phase = rng.uniform(0, 2 * np.pi, _WAVES) + time * rng.normal(0, 1 / memory, _WAVES)
    y, x = np.mgrid[0:49, 0:65]
    angle = 2 * np.pi * (across * (x / 64)[..., None] + down * (y / 48)[..., None]) + phase
    coarse = np.sqrt(2 / _WAVES) * np.cos(angle).sum(axis=-1)
    return cv2.resize(coarse.astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)


def weakness(oracle: SimulatedOracle, index: int) -> np.ndarray:
    """Return the lack of texture, float32 [H, W] in [0, 1]: 1 on a plain wall, 0 from a strength of 0.25."""
    texture = oracle.texture(index).astype(np.float32)
    around = cv2.GaussianBlur(texture, (0, 0), max(1.0, texture.shape[1] / 53))
    return np.clip(1.0 - around / _FULL_TEXTURE, 0.0, 1.0)


@dataclass(frozen=True)
class SimulatedMoge:
    """Error model: log depth = log truth + sigma(u) f(u, t) + wobble g, f a smooth field, g normal, one a frame.

    sigma(u) = error (1 + weak w(u)), with w in [0, 1] the lack of texture, and `glass` times that behind glass.
    error: relative deviation where texture is good. weak: how much larger it is without texture. cycles: waves of the
    error across the picture. memory: seconds over which the error of neighbouring frames stays alike. wobble: relative
    deviation of a frame's scale. The estimate states sqrt(sigma^2 + wobble^2) and a confidence error / sigma(u).
    """

    oracle: SimulatedOracle
    seed: int = 0
    error: float = 0.05
    weak: float = 0.6
    glass: float = 3.0
    cycles: float = 1.2
    memory: float = 1.0
    wobble: float = 0.02

    def estimate(
        self, image: np.ndarray, sensor_depth: np.ndarray | None = None, intrinsics: Sequence[float] | None = None
    ) -> DepthEstimate:
        """Return simulated depth of `image`; the sensor's depth is not used."""
        index = self.oracle.index_of(image)
        depth = self.oracle.depth(index)
        sigma = self.error * (1 + self.weak * weakness(self.oracle, index))
        sigma = sigma * np.where(self.oracle.glass(index), self.glass, 1.0)
        time = self.oracle.timestamp(index)
        field = smooth_field(stream(self.seed, "moge"), depth.shape, time, self.cycles, self.memory)
        scale = self.wobble * stream(self.seed, "moge", index).standard_normal()
        log_error = sigma * field + scale
        confidence = np.where(np.isfinite(depth), self.error / np.maximum(sigma, 1e-12), 0.0)
        stated = np.where(np.isfinite(depth), np.maximum(np.hypot(sigma, self.wobble), 1e-6), np.nan)
        return DepthEstimate(
            (depth * np.exp(log_error)).astype(np.float32), confidence.astype(np.float32), stated.astype(np.float32)
        )


@dataclass(frozen=True)
class SimulatedDino:
    """Error model: Omega = clip(floor + (1 - floor) (share s + (1 - share) e) + noise), made on patches of 16 px.

    s: strength of texture around the pixel, 0 to 1. e: nearness of a straight edge, exp(-distance / reach). noise:
    normal, one draw a patch, deviation `noise`. blind: factor behind glass, where attention is drawn by reflections.
    floor: least saliency. share: weight of texture against structure. reach: pixels. patch: side of a patch, pixels.
    """

    oracle: SimulatedOracle
    seed: int = 0
    noise: float = 0.08
    floor: float = 0.10
    share: float = 0.65
    reach: float = 12.0
    blind: float = 0.7
    patch: int = 16

    def confidence(self, image: np.ndarray) -> np.ndarray:
        """Return simulated Omega of `image`, float32 [H, W] in [0, 1]."""
        index = self.oracle.index_of(image)
        strength = 1.0 - weakness(self.oracle, index)
        height, width = strength.shape
        saliency = self.share * strength + (1 - self.share) * self._structure(index, (height, width))
        saliency = self.floor + (1 - self.floor) * saliency
        saliency = saliency * np.where(self.oracle.glass(index), self.blind, 1.0)
        grid = (-(-width // self.patch), -(-height // self.patch))
        coarse = cv2.resize(saliency.astype(np.float32), grid, interpolation=cv2.INTER_AREA)
        coarse += self.noise * stream(self.seed, "dino", index).standard_normal(coarse.shape, dtype=np.float32)
        smooth = cv2.resize(np.clip(coarse, 0, 1), (width, height), interpolation=cv2.INTER_LINEAR)
        return np.clip(smooth, 0.0, 1.0).astype(np.float32)

    def _structure(self, index: int, shape: tuple[int, int]) -> np.ndarray:
        canvas = np.full(shape, 255, np.uint8)
        for start, end in np.rint(self.oracle.edges(index).pixels).astype(int).tolist():
            cv2.line(canvas, tuple(start), tuple(end), 0, 1)
        distance = cv2.distanceTransform(canvas, cv2.DIST_L2, 3)
        return np.exp(-distance / self.reach)


@dataclass(frozen=True)
class SimulatedMast3r:
    """Error model, with w in [0, 1] the lack of texture at the key point and g = 1 behind glass, else 0.

    Key points: `count` a frame, drawn with weight spread + strength of texture. A key point that is seen in the other
    view is missed with probability missed (1 + 3 w). A match that is made is an outlier with probability
    outliers (1 + 9 w) + behind_glass g: its target lies `outlier_shift` pixels off (deviation of a normal). Other
    targets have normal noise of noise (1 + w) pixels an axis. Of key points that are not seen in the other view a
    share `imagined` is matched all the same, as an outlier. Confidence = clip(1 - 0.7 w - 0.3 outlier + 0.1 normal):
    it knows weak texture well and outliers a little.
    """

    simulated: ClassVar[bool] = True
    """Its descriptors are numbers of frames, which mean nothing in another run."""

    oracle: SimulatedOracle
    seed: int = 0
    count: int = 1500
    spread: float = 0.10
    noise: float = 0.5
    missed: float = 0.10
    outliers: float = 0.02
    behind_glass: float = 0.35
    outlier_shift: float = 25.0
    imagined: float = 0.02

    def describe(self, image: np.ndarray) -> Features:
        """Return simulated key points of `image`; the descriptor is the frame's number."""
        index = self.oracle.index_of(image)
        rng = stream(self.seed, "mast3r", index)
        texture = self.oracle.texture(index)[::2, ::2]
        weight = self.spread + texture.ravel()
        chosen = np.argsort(rng.exponential(size=weight.size) / weight)[: self.count]
        rows, columns = np.divmod(chosen, texture.shape[1])
        pixels = 2.0 * np.stack([columns, rows], axis=1) + rng.uniform(-0.5, 0.5, (len(chosen), 2))
        height, width = image.shape[:2]
        return Features(np.clip(pixels, 0, [width - 1, height - 1]), texture.ravel()[chosen], index)

    def match(self, features_i: Features, features_j: Features, predicted: np.ndarray | None = None) -> PointMatches:
        """Return simulated matches from view i to view j; `index_j` is -1: targets are no key points."""
        index_i, index_j = int(features_i.descriptors), int(features_j.descriptors)
        rng = stream(self.seed, "mast3r", index_i, index_j)
        pixels = features_i.pixels
        target, seen = self.oracle.correspond(index_i, index_j, pixels)
        weak = pinhole.at_pixels(weakness(self.oracle, index_i), pixels)
        glass = pinhole.at_pixels(self.oracle.glass(index_i), pixels)
        draw = rng.uniform(size=(3, len(pixels)))
        made = np.where(seen, draw[0] >= self.missed * (1 + 3 * weak), draw[0] < self.imagined)
        wrong = ~seen | (draw[1] < self.outliers * (1 + 9 * weak) + self.behind_glass * glass)
        blur = self.noise * (1 + weak[:, None]) * rng.standard_normal(pixels.shape)
        height, width = self.oracle.depth(index_j).shape
        anywhere = rng.uniform(size=pixels.shape) * [width - 1, height - 1]
        start = np.where(seen[:, None], target, anywhere)
        answer = start + np.where(wrong[:, None], self.outlier_shift * rng.standard_normal(pixels.shape), blur)
        made &= np.all((answer >= 0) & (answer <= [width - 1, height - 1]), axis=1)
        confidence = np.clip(1 - 0.7 * weak - 0.3 * wrong + 0.1 * rng.standard_normal(len(pixels)), 0, 1)
        rows = np.nonzero(made)[0]
        return PointMatches(rows, np.full(len(rows), -1), pixels[rows], answer[rows], confidence[rows])


@dataclass(frozen=True)
class SimulatedLetr:
    """Error model: an edge of contrast c (grey levels a pixel) is found with probability found c / (c + half).

    across, along: deviation of each end across and along its segment, pixels. false: mean number of false segments a
    frame (Poisson). shortest: pixels; shorter segments are not found. Scores are uniform in [0.7, 1] for true and in
    [0.7, 0.85] for false ones (LETR's own threshold is 0.7), so that a score tells a little and no more.
    """

    oracle: SimulatedOracle
    seed: int = 0
    across: float = 0.7
    along: float = 3.0
    found: float = 0.9
    half: float = 2.0
    false: float = 6.0
    shortest: float = 20.0

    def detect(self, image: np.ndarray) -> Segments:
        """Return simulated segments of `image`, best first."""
        index = self.oracle.index_of(image)
        rng = stream(self.seed, "letr", index)
        edges = self.oracle.edges(index)
        ends = np.asarray(edges.pixels, float).reshape(-1, 2, 2)
        contrast = np.asarray(edges.contrast)
        chance = self.found * contrast / (contrast + self.half + 1e-12)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        kept = (rng.uniform(size=len(ends)) < chance) & (length >= self.shortest)
        true = _noisy(ends[kept], self.across, self.along, rng)
        false = self._false_segments(image.shape[1], image.shape[0], rng)
        scores = np.concatenate([rng.uniform(0.7, 1.0, len(true)), rng.uniform(0.7, 0.85, len(false))])
        order = np.argsort(-scores, kind="stable")
        return Segments(np.concatenate([true, false])[order], scores[order])

    def _false_segments(self, width: int, height: int, rng: np.random.Generator) -> np.ndarray:
        count = int(rng.poisson(self.false))
        middle = rng.uniform(0, 1, (count, 2)) * [width - 1, height - 1]
        angle = rng.uniform(0, np.pi, count)
        half = 0.5 * rng.uniform(max(self.shortest, 1.0), 0.25 * width, count)
        way = half[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ends = np.stack([middle - way, middle + way], axis=1)
        return np.clip(ends, 0, [width - 1, height - 1])


def _noisy(ends: np.ndarray, across: float, along: float, rng: np.random.Generator) -> np.ndarray:
    """Return segments [L, 2, 2] with independent normal errors of their ends."""
    way = ends[:, 1] - ends[:, 0]
    way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=1)
    shift = rng.standard_normal((len(ends), 2, 2))
    return ends + along * shift[..., :1] * way[:, None] + across * shift[..., 1:] * normal[:, None]


_GRID = (12, 9)


@dataclass(frozen=True)
class SimulatedVggt:
    """Error model of a network that sees all views at once.

    Each view hangs on the earlier or later view with which it shares most (a tree of largest overlaps from the first
    view). The motion between the two has a normal error, per axis, of `rotation` (radians) and of `translation` times
    the distance moved plus `jitter` times the median depth; both grow by 1 / sqrt(overlap) and by 1 + weak w, w the
    mean lack of texture. Errors add up along the tree. A view that shares less than `min_overlap` of its pixels with
    all others is not found: a fast turn costs nothing as long as views overlap. The window's unit is the median depth
    of its first view, times a normal relative error `scale`. Depth has a smooth relative error sigma(u) =
    depth_error (1 + weak w(u)), `cycles` waves a picture, alike over `memory` seconds. Without given intrinsics the
    focal length is guessed with the relative error `focal`.
    """

    oracle: SimulatedOracle
    seed: int = 0
    rotation: float = 0.002
    translation: float = 0.02
    jitter: float = 0.001
    scale: float = 0.10
    depth_error: float = 0.04
    weak: float = 1.0
    cycles: float = 1.0
    memory: float = 2.0
    focal: float = 0.01
    min_overlap: float = 0.10

    def window(self, images: Sequence[np.ndarray], intrinsics: np.ndarray | None = None) -> WindowGuess:
        """Return simulated geometry of `images`; the first camera is the world."""
        indices = [self.oracle.index_of(image) for image in images]
        rng = stream(self.seed, "vggt", *indices)
        lacking = np.stack([weakness(self.oracle, index) for index in indices])
        depths = np.stack([self.oracle.depth(index) for index in indices])
        middle = float(np.nanmedian(depths[0]))
        unit = middle * float(np.exp(self.scale * rng.standard_normal()))
        poses, found = self._poses(indices, lacking.mean(axis=(1, 2)), middle, rng)
        poses[:, :3, 3] /= unit
        sigma = self.depth_error * (1 + self.weak * lacking)
        seed, times = int(rng.integers(2**31)), [self.oracle.timestamp(index) for index in indices]
        field = lambda time: smooth_field(stream(seed, "vggt"), depths[0].shape, time, self.cycles, self.memory)
        waves = np.stack([field(time) for time in times])
        certainty = np.where(np.isfinite(depths), self.depth_error / np.maximum(sigma, 1e-12), 0.0)
        return WindowGuess(
            poses=poses,
            intrinsics=self._intrinsics(intrinsics, rng),
            depth=(depths * np.exp(sigma * waves) / unit).astype(np.float32),
            confidence=(certainty * found[:, None, None]).astype(np.float32),
            found=found,
            result=GeometryResult.SUCCESS if found.all() else GeometryResult.TOO_FEW_MATCHES,
        )

    def _poses(
        self, indices: list[int], lacking: np.ndarray, middle: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return poses float64 [n, 4, 4] in metres, first camera = world, and which were found, bool [n]."""
        count = len(indices)
        truth = np.stack([self.oracle.pose(index) for index in indices])
        poses = np.tile(np.eye(4), (count, 1, 1))
        found = np.zeros(count, bool)
        found[0] = True
        errors = rng.standard_normal((count, 6))
        for view, parent, share in _tree(self._overlaps(indices), self.min_overlap):
            motion = truth[view] @ np.linalg.inv(truth[parent])
            growth = (1 + self.weak * lacking[view]) / np.sqrt(share)
            step = self.translation * float(np.linalg.norm(motion[:3, 3])) + self.jitter * middle
            wrong = np.eye(4)
            wrong[:3, :3] = Rotation.from_rotvec(growth * self.rotation * errors[view, 3:]).as_matrix()
            wrong[:3, 3] = growth * step * errors[view, :3]
            poses[view] = wrong @ motion @ poses[parent]
            found[view] = True
        for view in np.nonzero(~found)[0].tolist():
            poses[view] = poses[view - 1]
        return poses, found

    def _overlaps(self, indices: list[int]) -> np.ndarray:
        """Return the share of the pixels of view a that view b sees, the smaller of both directions: float [n, n]."""
        height, width = self.oracle.depth(indices[0]).shape
        columns = (np.arange(_GRID[0]) + 0.5) / _GRID[0] * width - 0.5
        rows = (np.arange(_GRID[1]) + 0.5) / _GRID[1] * height - 0.5
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        share = np.array([[self.oracle.correspond(a, b, pixels)[1].mean() for b in indices] for a in indices])
        return np.minimum(share, share.T)

    def _intrinsics(self, given: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
        if given is not None:
            return np.asarray(given, float)
        fx, fy, cx, cy = self.oracle.intrinsics
        error = float(np.exp(self.focal * rng.standard_normal()))
        return np.array([fx * error, fy * error, cx, cy])


def _tree(overlap: np.ndarray, least: float) -> list[tuple[int, int, float]]:
    """Return the tree of largest overlaps from view 0 as (view, parent, overlap), in order of addition."""
    placed, waiting = [0], set(range(1, len(overlap)))
    branches = []
    while waiting:
        share, view, parent = max((overlap[a, b], -a, -b) for a in waiting for b in placed)
        if share <= 0 or share < least:
            break
        branches.append((-view, -parent, float(share)))
        placed.append(-view)
        waiting.remove(-view)
    return branches
