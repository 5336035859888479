"""Simulated VGGT: poses and depth of a window at a scale of its own, with drift that grows where views share little."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation
from vggtgeo.models.roles import GeometryResult, WindowGuess
from vggtgeo.models.stubs.perception import Oracle, SmoothField, stream, weakness

_GRID = (12, 9)


@dataclass(frozen=True)
class SimulatedVggt:
    """Error model of a network that sees all views at once.

    Each view hangs on the earlier or later view with which it shares most (a tree of largest overlaps from the first
    view). The motion between the two has a normal error, per axis, of `rotation` (radians) and of `translation` times
    the distance moved plus `jitter` times the median depth; both grow by 1 / sqrt(overlap) and by 1 + weak w, w the
    mean lack of texture. Errors add up along the tree. A view that shares less than `least_overlap` of its pixels with
    all others is not found: a fast turn costs nothing as long as views overlap. The window's unit is the median depth
    of its first view, times a normal relative error `scale`. Depth has a smooth relative error sigma(u) =
    depth_error (1 + weak w(u)), `cycles` waves a picture, alike over `memory` seconds. Without given intrinsics the
    focal length is guessed with the relative error `focal`.
    """

    simulated: ClassVar[bool] = True

    oracle: Oracle
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
    least_overlap: float = 0.10

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
        field = SmoothField(int(rng.integers(2**31)), "vggt", self.cycles, self.memory)
        waves = np.stack([field.sample(depths[0].shape, self.oracle.timestamp(index)) for index in indices])
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
        for view, parent, share in _tree(self._overlaps(indices), self.least_overlap):
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
