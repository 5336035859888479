"""Which segments of two views the geometry allows to be the same line."""

from __future__ import annotations

import numpy as np
from vggtgeo.models.classical.line_geometry import line_coefficients
from vggtgeo.models.roles import RelativeView

from vggtgeo.geometry import pinhole


def allowed_pairs(
    ends_i: np.ndarray,
    ends_j: np.ndarray,
    relative: RelativeView | None,
    angle: float,
    distance: float,
    overlap: float,
) -> np.ndarray:
    """Return bool [L_i, L_j]: pairs of segments that can be one line.

    Without `relative`: their directions differ by less than `angle`. With it, a segment whose depth is known is
    moved into j and must lie within `distance` pixels of the other, and what the view may be off, in its direction,
    and overlap it; one whose depth is unknown must, between the epipolar lines of its ends, overlap the other.

    ends_i: float [L_i, 2, 2]. ends_j: float [L_j, 2, 2].
    """
    if not len(ends_i) or not len(ends_j):
        return np.zeros((len(ends_i), len(ends_j)), dtype=bool)
    if relative is None:
        return _direction_cosine(ends_i, ends_j) > np.cos(angle)
    moved = _move(ends_i, relative)
    known = np.isfinite(moved).all(axis=(1, 2))
    allowed = np.zeros((len(ends_i), len(ends_j)), dtype=bool)
    allowed[known] = _near(moved[known], ends_j, distance + relative.error, overlap)
    allowed[~known] = _on_epipolar_beam(ends_i[~known], ends_j, relative, angle, overlap)
    return allowed


def _direction_cosine(ends_i: np.ndarray, ends_j: np.ndarray) -> np.ndarray:
    first, second = _directions(ends_i)[0], _directions(ends_j)[0]
    return first @ second.T


def _directions(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    along = ends[:, 1] - ends[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    return along / length[:, None], length


def _move(ends: np.ndarray, relative: RelativeView) -> np.ndarray:
    """Return where the ends of i appear in j, float [L, 2, 2]; NaN where depth is unknown or the end is behind j."""
    rays = pinhole.rays(ends, relative.intrinsics)
    if np.linalg.norm(relative.pose[:3, 3]) < 1e-9:
        depths = np.ones(ends.shape[:2])  # Without a baseline depth has no effect.
    elif relative.depths is None:
        return np.full_like(ends, np.nan)
    else:
        depths = relative.depths
    points = (rays * depths[..., None]) @ relative.pose[:3, :3].T + relative.pose[:3, 3]
    return pinhole.project(points, relative.intrinsics)


def _near(moved: np.ndarray, ends_j: np.ndarray, distance: float, overlap: float) -> np.ndarray:
    lines = line_coefficients(ends_j)
    direction, length = _directions(ends_j)
    start = (ends_j[:, 0] * direction).sum(axis=1)
    near = np.ones((len(moved), len(ends_j)), dtype=bool)
    places = []
    for end in (moved[:, 0], moved[:, 1]):
        near &= np.abs(end @ lines[:, :2].T + lines[:, 2]) < distance
        places.append(end @ direction.T - start)
    common = _common_part(places[0], places[1], length, _directions(moved)[1])
    # A predicted end may miss by `distance`; both together must not turn the segment by more than 15 degrees.
    return near & (common > overlap) & (_direction_cosine(moved, ends_j) > np.cos(0.26))


def _common_part(first: np.ndarray, second: np.ndarray, length: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return the common part of [0, length_j] and intervals `first` to `second` [L_i, L_j], over the shorter one."""
    common = np.minimum(np.maximum(first, second), length) - np.maximum(np.minimum(first, second), 0.0)
    return common / np.maximum(np.minimum(length[None, :], own[:, None]), 1.0)


def _on_epipolar_beam(
    ends_i: np.ndarray, ends_j: np.ndarray, relative: RelativeView, angle: float, overlap: float
) -> np.ndarray:
    if not len(ends_i):
        return np.zeros((0, len(ends_j)), dtype=bool)
    to_rays = np.linalg.inv(pinhole.matrix(relative.intrinsics))
    x, y, z = relative.pose[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    fundamental = to_rays.T @ cross @ relative.pose[:3, :3] @ to_rays
    epipolar = np.concatenate([ends_i, np.ones_like(ends_i[..., :1])], axis=2) @ fundamental.T
    direction, length = _directions(ends_j)
    # Along end 0 + s * direction the epipolar line l is met at s = -l(end 0) / (l . direction).
    places, anywhere = [], np.zeros((len(ends_i), len(ends_j)), dtype=bool)
    for line in (epipolar[:, 0], epipolar[:, 1]):
        rate = line[:, :2] @ direction.T
        # A segment almost along its epipolar line is met nowhere in particular: the gate then says nothing.
        parallel = np.abs(rate) < np.sin(0.17) * np.linalg.norm(line[:, :2], axis=1)[:, None]
        places.append(-(line[:, :2] @ ends_j[:, 0].T + line[:, 2:]) / np.where(parallel, 1.0, rate))
        anywhere |= parallel
    own = np.abs(places[1] - places[0]).mean(axis=1)
    meets = _common_part(places[0], places[1], length, own) > overlap
    return (meets | anywhere) & (_direction_cosine(_turned(ends_i, relative), ends_j) > np.cos(angle))


def _turned(ends: np.ndarray, relative: RelativeView) -> np.ndarray:
    """Return the ends as they appear after the rotation alone: how the image of a far segment turns."""
    matrix = pinhole.matrix(relative.intrinsics)
    homography = matrix @ relative.pose[:3, :3] @ np.linalg.inv(matrix)
    moved = np.concatenate([ends, np.ones_like(ends[..., :1])], axis=2) @ homography.T
    return moved[..., :2] / np.maximum(moved[..., 2:], 1e-3)
