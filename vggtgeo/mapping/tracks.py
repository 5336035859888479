"""Tracks: each point of the map with all its observations, as in structure from motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe

MAX_ERROR = 4.0
"""Largest reprojection error of an observation, pixels: two scales of the adjustment's Cauchy kernel."""
ITERATIONS = 4
"""Of Gauss-Newton per point; two suffice at usual parallax, from the point nearest to the rays."""
MIN_PARALLAX = 1e-2
"""Angle between the rays of a point's first and any other view, radians, needed to triangulate it."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points and their observations.

    Fields: points float64 [n, 3], world; colours uint8 [n, 3]; of the m observations, sorted by point: point int [m],
    view int [m] (index of the keyframe), pixel float64 [m, 2].
    """

    points: np.ndarray
    colours: np.ndarray
    point: np.ndarray
    view: np.ndarray
    pixel: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def errors(self, poses: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Return the reprojection errors, float64 [m], pixels; poses float64 [k, 4, 4], world -> camera."""
        projected = pinhole.project(_local(self.points, self.point, self.view, poses), intrinsics)
        distance: np.ndarray = np.linalg.norm(projected - self.pixel, axis=1)
        return distance

    def mean_error(self, poses: np.ndarray, intrinsics: np.ndarray) -> float:
        """Return the mean over points of each point's mean error, pixels, as COLMAP reports it."""
        count = np.bincount(self.point, minlength=len(self))
        total = np.bincount(self.point, self.errors(poses, intrinsics), minlength=len(self))
        return float(np.mean(total / np.maximum(count, 1))) if len(self) else 0.0


def make_tracks(keyframes: Sequence[Keyframe], pairs: Sequence[Pair], intrinsics: np.ndarray) -> Tracks:
    """Build tracks from all matches between keyframes, and triangulate them with fixed poses.

    Key points connected by matches are one track; of several in one image the first is used. Observations with an error
    above `MAX_ERROR` are left out, and points with fewer than two observations left.
    """
    poses = np.array([keyframe.pose for keyframe in keyframes]).reshape(-1, 4, 4)
    track, view, pixel = _connect(keyframes, pairs)
    points = np.zeros((0, 3))
    for _ in range(2):  # with all observations, then without the outliers
        track, view, pixel = _renumber(track, view, pixel)
        points = _triangulate(track, view, pixel, poses, intrinsics)
        with np.errstate(invalid="ignore"):
            error = np.linalg.norm(pinhole.project(_local(points, track, view, poses), intrinsics) - pixel, axis=1)
            good = (error < MAX_ERROR) & _has_parallax(track, view, poses, points)[track]
        track, view, pixel = track[good], view[good], pixel[good]
    kept, first, row = np.unique(track, return_index=True, return_inverse=True)
    many = np.bincount(row, minlength=len(kept)) > 1
    stays = many[row]
    colours = _colours(keyframes, view[first[many]], pixel[first[many]])
    renumbered = np.cumsum(many) - 1
    return Tracks(points[kept[many]], colours, renumbered[row[stays]], view[stays], pixel[stays])


def _connect(keyframes: Sequence[Keyframe], pairs: Sequence[Pair]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return track, view and pixel of each observation: connected components of matched key points."""
    first = np.cumsum([0, *(len(keyframe.features) for keyframe in keyframes)])
    place = {keyframe.number: i for i, keyframe in enumerate(keyframes)}
    own = [first[place[pair.first]] + pair.points.index_i for pair in pairs]
    loose, other, targets = int(first[-1]), [], []
    for pair in pairs:
        matched = pair.points.index_j >= 0
        numbers = np.where(matched, first[place[pair.second]] + pair.points.index_j, 0)
        numbers[~matched] = loose + np.arange(np.count_nonzero(~matched))  # a target without key point is its own node
        loose += int(np.count_nonzero(~matched))
        other.append(numbers)
        targets.append(pair.points.pixels_j)
    if not own or not sum(map(len, own)):
        return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))
    i, j = np.concatenate(own), np.concatenate(other)
    view_of, pixel_of = np.zeros(loose, int), np.zeros((loose, 2))
    for k, keyframe in enumerate(keyframes):
        view_of[first[k] : first[k + 1]], pixel_of[first[k] : first[k + 1]] = k, keyframe.features.pixels
    view_of[j] = np.repeat([place[pair.second] for pair in pairs], [len(numbers) for numbers in other])
    pixel_of[j] = np.concatenate(targets)  # sub-pixel refined, more accurate than the key point
    _, component = connected_components(coo_array((np.ones(len(i), bool), (i, j)), shape=(loose, loose)), False)
    used = np.unique(np.concatenate([i, j]))
    # A point has one place in an image: of several, all but the first are mismatches.
    _, once = np.unique(np.stack([component[used], view_of[used]]), axis=1, return_index=True)
    used = used[once]
    return component[used], view_of[used], pixel_of[used]


def _renumber(track: np.ndarray, view: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sort the observations of tracks with two or more, and number these tracks from 0."""
    _, row, count = np.unique(track, return_inverse=True, return_counts=True)
    many = np.nonzero(count[row] > 1)[0]
    _, row = np.unique(track[many], return_inverse=True)
    order = np.argsort(row, kind="stable")
    return row[order], view[many][order], pixel[many][order]


def _local(points: np.ndarray, point: np.ndarray, view: np.ndarray, poses: np.ndarray) -> np.ndarray:
    local: np.ndarray = np.einsum("nij,nj->ni", poses[view, :3, :3], points[point]) + poses[view, :3, 3]
    return local


def _triangulate(
    track: np.ndarray, view: np.ndarray, pixel: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Return points float64 [n, 3] that minimise the robust reprojection error, starting nearest to all rays.

    All points are independent, so that they are solved as one batch of 3 x 3 systems.
    """
    count = int(track.max()) + 1 if len(track) else 0
    rotation = poses[view, :3, :3]
    centre = -np.einsum("nji,nj->ni", rotation, poses[view, :3, 3])
    ray = np.einsum("nji,nj->ni", rotation, pinhole.rays(pixel, intrinsics))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]  # sum |across (x - centre)|^2: distance from the rays
    points = _solve_sums(count, track, across, np.einsum("nij,nj->ni", across, centre))
    # Not `gauss_newton`, point by point: 20,000 points of six views take 0.6 s instead of 10 s.
    for _ in range(ITERATIONS):
        local = _local(points, track, view, poses)
        ahead = local[:, 2] > 1e-3
        safe = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])
        residual = pixel - pinhole.project(safe, intrinsics)
        rows = pinhole.projection_rows(safe, intrinsics)
        columns = np.stack([row[:3].T for row in rows], axis=1) @ rotation  # d(pixel)/d(world point) = d(pixel)/dt R
        weight = np.where(ahead, 1.0 / (1.0 + (residual**2).sum(1) / MAX_ERROR**2), 0.0)  # Cauchy
        normal = np.einsum("n,nki,nkj->nij", weight, columns, columns)
        points = points + _solve_sums(count, track, normal, np.einsum("n,nki,nk->ni", weight, columns, residual))
    return points


def _solve_sums(count: int, track: np.ndarray, matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Sum the normal equations of each track and solve them; float64 [count, 3]."""
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, track, matrix)
    np.add.at(right, track, vector)
    # Nearly parallel rays leave the depth free; `_has_parallax` removes such points afterwards.
    damping = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
    return np.linalg.solve(normal + damping * np.eye(3), right[..., None])[..., 0]


def _has_parallax(track: np.ndarray, view: np.ndarray, poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return whether two views of a point see it from different directions, bool [n]."""
    centres = rigid.invert(poses)[view, :3, 3]
    ray = points[track] - centres
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    first = ray[np.searchsorted(track, np.arange(len(points)))][track]
    apart = np.linalg.norm(ray - first, axis=1)
    widest = np.zeros(len(points))
    np.maximum.at(widest, track, apart)
    return widest > MIN_PARALLAX


def _colours(keyframes: Sequence[Keyframe], view: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Return the colour of each pixel [n, 2] in the image of its view [n], uint8 [n, 3]; each image is decoded once."""
    colours = np.zeros((len(view), 3), np.uint8)
    for number in np.unique(view):
        here = view == number
        colours[here] = pinhole.at_pixels(keyframes[number].image, pixel[here])
    return colours
