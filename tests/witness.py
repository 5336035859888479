"""What corners of a room of points would have shown to an `EvidenceRecorder`, with exact poses: for tests of checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import FrameEvidence

K = np.array([500.0, 500.0, 319.5, 239.5])
SIZE = (640, 480)
Lens = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Walk:
    """The truth as an estimate, and what was seen."""

    estimate: Estimate
    evidence: list[FrameEvidence]

    def with_poses(self, poses: np.ndarray) -> Estimate:
        """The estimate with other poses."""
        return replace(self.estimate, poses=poses)


def walk(
    count: int = 40,
    seed: int = 0,
    noise: float = 0.3,
    lens: Lens | None = None,
    step: float = 0.06,
    sway: float = 1.0,
) -> Walk:
    """A sideways walk with turns past points 1.5 to 5 m away.

    noise: of the pixels; depth has 1 % and is wrong (an edge) at 2 % of the points. lens: what the camera does to ideal
    pixels, float64 [m, 2] -> [m, 2]. step: how far it goes sideways a frame; sway: other motion; both 0: turns alone.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(count) / 10
    centres = np.column_stack([step * np.arange(count), 0.05 * sway * np.sin(times), 0.3 * sway * np.sin(0.5 * times)])
    turns = Rotation.from_euler("yx", np.column_stack([0.15 * np.sin(0.8 * times), 0.05 * np.cos(times)]))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], centres)
    points = np.column_stack(
        [rng.uniform(-4, 4 + step * count, 4000), rng.uniform(-3, 3, 4000), rng.uniform(1.5, 5, 4000)]
    )
    evidence = []
    for row in range(count):
        local = points @ poses[row, :3, :3].T + poses[row, :3, 3]
        pixels = rigid.project(points, poses[row], K)
        seen = lens(pixels) if lens else pixels
        seen = seen + noise * rng.standard_normal(seen.shape)
        inside = (local[:, 2] > 0.3) & (seen > 4).all(1) & (seen < np.array(SIZE) - 5).all(1)
        ids = np.nonzero(inside & (np.arange(len(points)) % 6 == 0))[0]
        depth = local[ids, 2] * (1 + 0.01 * rng.standard_normal(len(ids)))
        depth[rng.random(len(ids)) < 0.02] *= 1.4
        median = float(np.median(depth))
        pixel, z = seen[ids].astype(np.float32), depth.astype(np.float32)
        evidence.append(FrameEvidence(row, float(times[row]), ids.astype(np.int32), pixel, z, median, 1.0, 50.0))
    frames, sure = np.arange(count), np.ones(count, bool)
    seen = np.array([len(frame.ids) for frame in evidence]), frames % 3 == 0
    return Walk(Estimate(frames, times, poses, sure, K.copy(), K.copy(), np.full(4, 5.0), True, *seen), evidence)


def with_depth(evidence: list[FrameEvidence], change: Callable[[FrameEvidence], np.ndarray]) -> list[FrameEvidence]:
    """The same frames with other depths at the corners."""
    changed = [(frame, change(frame).astype(np.float32)) for frame in evidence]
    return [replace(frame, depth=depth, depth_median=float(np.median(depth))) for frame, depth in changed]
