"""Corners of a room of points as an `CornerRecorder` would follow them, with known truth: tests of the verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.alternatives import Explanation, explain
from vggtgeo.slam.verdict.claim import Claim, Tracks, tracks_of
from vggtgeo.slam.verdict.corner_recorder import FrameCorners

K = np.array([500.0, 500.0, 319.5, 239.5])
SIZE = (640, 480)
Bent = Callable[[int, np.ndarray], np.ndarray]
"""Row of the frame, pixels (or depths) -> what the camera shows in their place."""


@dataclass(frozen=True, eq=False)
class Walk:
    """The truth as the claim of a run, and what was seen."""

    claim: Claim
    evidence: list[FrameCorners]

    def tracks(self, claim: Claim | None = None) -> Tracks:
        """Of all frames, with another claim where one is given."""
        claim = claim or self.claim
        tracks = tracks_of(claim, self.evidence, np.arange(len(claim)), SIZE)
        assert tracks is not None
        return tracks

    def explanation(self, **claimed: object) -> Explanation:
        """What the corners prefer to the true claim with these fields in place of its own."""
        return explain(self.tracks(replace(self.claim, **claimed)))  # type: ignore[arg-type]


def walk(
    count: int = 20,
    seed: int = 0,
    noise: float = 0.3,
    density: int = 12,
    seen: Bent | None = None,
    measured: Bent | None = None,
) -> Walk:
    """A walk sideways with turns past points 1.5 to 5 m away.

    noise: of the pixels, independent; depth has 1 %, and is wrong (an edge) at 2 % of the points. density: one point in
    so many is followed. seen: what the camera does to ideal pixels. measured: what it does to depths.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(count) / 10
    centres = np.column_stack([0.06 * np.arange(count), 0.05 * np.sin(times), 0.3 * np.sin(0.5 * times)])
    turns = Rotation.from_euler("yx", np.column_stack([0.15 * np.sin(0.8 * times), 0.05 * np.cos(times)]))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], centres)
    points = rng.uniform([-4, -3, 1.5], [4 + 0.06 * count, 3, 5], (4000, 3))
    followed = np.flatnonzero(np.arange(len(points)) % density == 0)
    evidence = []
    for row in range(count):
        local = points[followed] @ poses[row, :3, :3].T + poses[row, :3, 3]
        pixels = rigid.project(points[followed], poses[row], K)
        pixels = seen(row, pixels) if seen else pixels
        inside = (local[:, 2] > 0.3) & (pixels > 4).all(1) & (pixels < np.array(SIZE) - 5).all(1)
        there = np.flatnonzero(inside)
        z = local[there, 2] * (1 + 0.01 * rng.standard_normal(len(there)))
        z[rng.random(len(there)) < 0.02] *= 1.4
        z = measured(row, z) if measured else z
        shown = pixels[there] + noise * rng.standard_normal((len(there), 2))
        evidence.append(
            FrameCorners(row, float(times[row]), there.astype(np.int32), shown.astype(np.float32), z.astype(np.float32))
        )
    return Walk(Claim(np.arange(count), times, poses, np.ones(count, bool), K.copy(), True), evidence)
