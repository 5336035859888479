"""View selection for multi-view stereo: neighbours that see the same points with enough parallax."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.slam.sparse_map.keyframe import Keyframe

GOOD_ANGLE = np.radians(3.0)
"""Triangulation angle from which the weight is 1: below it depth is uncertain."""
WIDE_ANGLE = np.radians(12.0)
"""Above it the weight falls: windows on slanted surfaces, such as floors, look too different."""
MIN_SCORE = 0.08
"""Neighbours with a lower score are left out."""
MAX_POINTS = 150
"""Points that are scored, of a keyframe's: a sample, for speed."""


def known_points(keyframe: Keyframe, intrinsics: np.ndarray) -> np.ndarray:
    """Return the keyframe's key points and line samples of known depth as world points, float64 [n, 3]."""
    parts = []
    for slots in (keyframe.points, keyframe.samples):
        known = slots.determined & (slots.inverse_depth > 0.02)
        parts.append(rigid.unproject(slots.pixels[known], slots.inverse_depth[known], keyframe.pose, intrinsics))
    return np.concatenate(parts)


def choose_views(keyframes: Sequence[Keyframe], intrinsics: np.ndarray, max_views: int) -> list[tuple[int, ...]]:
    """Return for each keyframe the indices in `keyframes` of its best neighbours, at most `max_views`, best first.

    The score of a neighbour is the mean weight of the keyframe's known points: 0 where the point is not visible, else
    rising with the triangulation angle to `GOOD_ANGLE` and falling beyond `WIDE_ANGLE`, as in COLMAP's view selection
    (Schoenberger et al., "Pixelwise view selection for unstructured multi-view stereo", ECCV 2016).
    """
    centres = np.array([rigid.centre(keyframe.pose) for keyframe in keyframes]).reshape(-1, 3)
    chosen: list[tuple[int, ...]] = []
    for i, keyframe in enumerate(keyframes):
        points = known_points(keyframe, intrinsics)
        points = points[:: max(1, len(points) // MAX_POINTS)]
        if not len(points):
            chosen.append(())
            continue
        # A baseline longer than the median depth gives angles beyond `WIDE_ANGLE`: such keyframes are not scored.
        depth = float(np.median(np.linalg.norm(points - centres[i], axis=1)))
        near = np.nonzero(np.linalg.norm(centres - centres[i], axis=1) < depth)[0]
        scores = {j: _score(points, centres[i], keyframes[j], intrinsics) for j in near.tolist() if j != i}
        ranked = sorted(scores, key=lambda j: -scores[j])
        chosen.append(tuple(j for j in ranked[:max_views] if scores[j] > MIN_SCORE))
    return chosen


def _score(points: np.ndarray, centre: np.ndarray, other: Keyframe, intrinsics: np.ndarray) -> float:
    local = points @ other.pose[:3, :3].T + other.pose[:3, 3]
    inside, _, _ = pinhole.visible(local, intrinsics, other.size)
    first, second = points - centre, points - rigid.centre(other.pose)
    cosine = (first * second).sum(1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))
    angle = np.arccos(np.clip(cosine, -1, 1))
    weight = np.minimum(angle / GOOD_ANGLE, 1.0) * np.exp(-(np.maximum(angle / WIDE_ANGLE - 1.0, 0.0) ** 2))
    return float(np.mean(np.where(inside, weight, 0.0)))
