"""Which keyframes are compared with which: those that see the same points from a useful angle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.sparse_map.keyframe import Keyframe

GOOD_ANGLE = np.radians(3.0)
"""Triangulation angle from which a neighbour counts in full: below it depth is uncertain."""
WIDE_ANGLE = np.radians(12.0)
"""Above it windows of slanted surfaces, floors above all, look too different: it counts less and less."""
LEAST_SCORE = 0.08
"""A neighbour that sees less than this share of the points is left out."""
MOST_POINTS = 150


def known_points(keyframe: Keyframe, intrinsics: np.ndarray) -> np.ndarray:
    """World points float64 [n, 3] of the keyframe's key points and line samples whose depth is known."""
    parts = []
    for slots in (keyframe.points, keyframe.samples):
        known = np.isfinite(slots.inverse_depth) & (slots.inverse_depth > 0.02)
        parts.append(rigid.unproject(slots.pixels[known], slots.inverse_depth[known], keyframe.pose, intrinsics))
    return np.concatenate(parts)


def choose_views(keyframes: Sequence[Keyframe], intrinsics: np.ndarray, most: int) -> list[tuple[int, ...]]:
    """For each keyframe the places in `keyframes` of its best neighbours, at most `most`, the best first.

    The score of a neighbour is the mean over the keyframe's known points of a weight that is 0 where it does not see
    the point, and else rises with the triangulation angle to `GOOD_ANGLE` and falls beyond `WIDE_ANGLE` (as the view
    selection of COLMAP does: Schoenberger et al., "Pixelwise view selection for unstructured multi-view stereo", ECCV
    2016).
    """
    centres = np.array([rigid.centre(keyframe.pose) for keyframe in keyframes]).reshape(-1, 3)
    chosen: list[tuple[int, ...]] = []
    for i, keyframe in enumerate(keyframes):
        points = known_points(keyframe, intrinsics)
        points = points[:: max(1, len(points) // MOST_POINTS)]
        if not len(points):
            chosen.append(())
            continue
        reach = float(np.median(np.linalg.norm(points - centres[i], axis=1)))
        near = np.nonzero(np.linalg.norm(centres - centres[i], axis=1) < reach)[0]
        scores = {j: _score(points, centres[i], keyframes[j], intrinsics) for j in near.tolist() if j != i}
        ranked = sorted(scores, key=lambda j: -scores[j])
        chosen.append(tuple(j for j in ranked[:most] if scores[j] > LEAST_SCORE))
    return chosen


def _score(points: np.ndarray, centre: np.ndarray, other: Keyframe, intrinsics: np.ndarray) -> float:
    local = points @ other.pose[:3, :3].T + other.pose[:3, 3]
    inside, _, _ = pinhole.visible(local, intrinsics, other.size)
    first, second = points - centre, points - rigid.centre(other.pose)
    cosine = (first * second).sum(1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))
    angle = np.arccos(np.clip(cosine, -1, 1))
    weight = np.minimum(angle / GOOD_ANGLE, 1.0) * np.exp(-(np.maximum(angle / WIDE_ANGLE - 1.0, 0.0) ** 2))
    return float(np.mean(np.where(inside, weight, 0.0)))
