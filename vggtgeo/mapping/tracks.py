"""Tracks: each point of the map with all the pixels that show it, as structure from motion keeps them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe, read_at

GATE = 4.0
"""Largest reprojection error of an observation, pixels: two standard deviations of the adjustment's Cauchy kernel."""
STEPS = 4
"""Of Gauss-Newton on a point; from the rays' midpoint two suffice at common parallax."""
FAR = 1e-2
"""Least angle between the rays of a point's first and any other view, radians, below which its distance is not
known."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Fields: points float64 [n, 3], world; colours uint8 [n, 3]; and of the m observations, sorted by point: point int
    [m], view int [m] (place of the keyframe), pixel float64 [m, 2].
    """

    points: np.ndarray
    colours: np.ndarray
    point: np.ndarray
    view: np.ndarray
    pixel: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def errors(self, poses: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Reprojection error of each observation, float64 [m], pixels; poses float64 [k, 4, 4], world -> camera."""
        seen = pinhole.project(_local(self.points, self.point, self.view, poses), intrinsics)
        distance: np.ndarray = np.linalg.norm(seen - self.pixel, axis=1)
        return distance

    def mean_error(self, poses: np.ndarray, intrinsics: np.ndarray) -> float:
        """Mean over the points of the mean error of each, pixels, as COLMAP states it."""
        count = np.bincount(self.point, minlength=len(self))
        total = np.bincount(self.point, self.errors(poses, intrinsics), minlength=len(self))
        return float(np.mean(total / np.maximum(count, 1))) if len(self) else 0.0


def make_tracks(keyframes: Sequence[Keyframe], pairs: Sequence[Pair], intrinsics: np.ndarray) -> Tracks:
    """The tracks of all matches between keyframes, triangulated with their poses held.

    Matches that share a key point are one track; of two key points of one image only the first stays. An observation
    that misses its point by more than `GATE` is left out, and a point that fewer than two views are left of.
    """
    poses = np.array([keyframe.pose for keyframe in keyframes]).reshape(-1, 4, 4)
    track, view, pixel = _joined(keyframes, pairs)
    points = np.zeros((int(track.max()) + 1 if len(track) else 0, 3))
    for _ in range(2):  # once with all, once without what misses
        track, view, pixel = _numbered(track, view, pixel)
        points = _triangulated(track, view, pixel, poses, intrinsics)
        with np.errstate(invalid="ignore"):
            error = np.linalg.norm(pinhole.project(_local(points, track, view, poses), intrinsics) - pixel, axis=1)
            good = (error < GATE) & _wide(track, view, poses, points)[track]
        track, view, pixel = track[good], view[good], pixel[good]
    kept, first, row = np.unique(track, return_index=True, return_inverse=True)
    many = np.bincount(row, minlength=len(kept)) > 1 if len(kept) else np.zeros(0, bool)
    stays = many[row] if len(kept) else np.zeros(0, bool)
    colours = _colours(keyframes, view[first[many]], pixel[first[many]]) if len(kept) else np.zeros((0, 3), np.uint8)
    renumbered = np.cumsum(many) - 1
    return Tracks(points[kept[many]], colours, renumbered[row[stays]], view[stays], pixel[stays])


def _joined(keyframes: Sequence[Keyframe], pairs: Sequence[Pair]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Track, view and pixel of each observation: connected components of matched key points."""
    first = np.cumsum([0, *(len(keyframe.features) for keyframe in keyframes)])
    place = {keyframe.number: i for i, keyframe in enumerate(keyframes)}
    own = [first[place[pair.first]] + pair.points.index_i for pair in pairs]
    loose, other, targets = int(first[-1]), [], []
    for pair in pairs:
        named = pair.points.index_j >= 0
        numbers = np.where(named, first[place[pair.second]] + pair.points.index_j, 0)
        numbers[~named] = loose + np.arange(np.count_nonzero(~named))  # a target that is no key point is its own node
        loose += int(np.count_nonzero(~named))
        other.append(numbers)
        targets.append(pair.points.pixels_j)
    if not own or not sum(map(len, own)):
        return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))
    i, j = np.concatenate(own), np.concatenate(other)
    view_of, pixel_of = np.zeros(loose, int), np.zeros((loose, 2))
    for k, keyframe in enumerate(keyframes):
        view_of[first[k] : first[k + 1]], pixel_of[first[k] : first[k + 1]] = k, keyframe.features.pixels
    view_of[j] = np.repeat([place[pair.second] for pair in pairs], [len(numbers) for numbers in other])
    pixel_of[j] = np.concatenate(targets)  # refined beyond the key point
    _, component = connected_components(coo_array((np.ones(len(i), bool), (i, j)), shape=(loose, loose)), False)
    used = np.unique(np.concatenate([i, j]))
    _, once = np.unique(np.stack([component[used], view_of[used]]), axis=1, return_index=True)
    used = used[once]
    return component[used], view_of[used], pixel_of[used]


def _numbered(track: np.ndarray, view: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The observations of tracks of at least two, sorted, the tracks numbered from 0."""
    _, row, count = np.unique(track, return_inverse=True, return_counts=True)
    many = np.nonzero(count[row] > 1)[0]
    _, row = np.unique(track[many], return_inverse=True)
    order = np.argsort(row, kind="stable")
    return row[order], view[many][order], pixel[many][order]


def _local(points: np.ndarray, point: np.ndarray, view: np.ndarray, poses: np.ndarray) -> np.ndarray:
    local: np.ndarray = np.einsum("nij,nj->ni", poses[view, :3, :3], points[point]) + poses[view, :3, 3]
    return local


def _triangulated(
    track: np.ndarray, view: np.ndarray, pixel: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Points float64 [n, 3] of least reprojection error, from the point nearest to all rays."""
    count = int(track.max()) + 1 if len(track) else 0
    rotation = poses[view, :3, :3]
    centre = -np.einsum("nji,nj->ni", rotation, poses[view, :3, 3])
    ray = np.einsum("nji,nj->ni", rotation, pinhole.rays(pixel, intrinsics))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    points = _solved(count, track, across, np.einsum("nij,nj->ni", across, centre))
    for _ in range(STEPS):
        local = _local(points, track, view, poses)
        ahead = local[:, 2] > 1e-3
        safe = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])
        residual = pixel - pinhole.project(safe, intrinsics)
        rows = pinhole.projection_rows(safe, intrinsics)
        columns = np.stack([row[:3].T for row in rows], axis=1) @ rotation  # by the point: translation rows, turned
        weight = np.where(ahead, 1.0 / (1.0 + (residual**2).sum(1) / GATE**2), 0.0)  # Cauchy
        normal = np.einsum("n,nki,nkj->nij", weight, columns, columns)
        points = points + _solved(count, track, normal, np.einsum("n,nki,nk->ni", weight, columns, residual))
    return points


def _solved(count: int, track: np.ndarray, matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """The solutions float64 [count, 3] of the sums over each track."""
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, track, matrix)
    np.add.at(right, track, vector)
    damping = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
    return np.linalg.solve(normal + damping * np.eye(3), right[..., None])[..., 0]


def _wide(track: np.ndarray, view: np.ndarray, poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether two views of a point, bool [n], see it from different directions."""
    centres = rigid.invert(poses)[view, :3, 3]
    ray = points[track] - centres
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    first = ray[np.searchsorted(track, np.arange(len(points)))][track]
    apart = np.linalg.norm(ray - first, axis=1)
    widest = np.zeros(len(points))
    np.maximum.at(widest, track, apart)
    return widest > FAR


def _colours(keyframes: Sequence[Keyframe], view: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """The colour of each pixel [n, 2], uint8 [n, 3], in the picture of its view [n]; each picture is opened once."""
    colours = np.zeros((len(view), 3), np.uint8)
    for number in np.unique(view):
        here = view == number
        colours[here] = read_at(keyframes[number].image, pixel[here])
    return colours
