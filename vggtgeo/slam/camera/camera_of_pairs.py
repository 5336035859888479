"""The camera by pairs of images whose depth is known: focal length, principal point and distortion, poses eliminated.

For pairs of frames, in both directions, pixels `p` with known depth are carried to the other
frame, `q = distort(pi(T pi^-1(undistort(p), z)))`, and the relative pose `T` of each pair is solved together with four
parameters of the camera that all pairs share: a factor on the focal lengths, the shift of the principal point, and the
first radial coefficient `k1`. Gauss-Newton with Huber weights; the poses are eliminated pair by pair (Schur), so it is
a bundle adjustment whose depths are given. Errors of these depths pull the focal length one way where the camera
goes forward and the other way where it goes back; both directions together cancel most of it.

The covariance is the sandwich over `B` blocks of time, `B / (B - 4) S^-1 (sum g_b g_b') S^-1`: it needs no noise model,
and neighbouring pairs may share their errors. `k1` is always free: a lens that distorts bends a focal length that is
sought without it (redkitchen: 538 px without, 521 with; COLMAP 522 and 520).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student_t

from vggtgeo.geometry import rigid
from vggtgeo.slam.threads import map_in_threads

MIN_PAIRS = 8
PARAMETERS = 4
MIN_BLOCKS = PARAMETERS + 2
ITERATIONS, SETTLED = 20, 0.002
"""At most, and the step, in the longest ones, below which there are no more. Half the focal length is seven of these
away."""
POSE_ITERATIONS = 4
AT_ONCE = 200
"""Pairs, of some hundred points: 20 MB."""
HUBER = 1.0
FARTHEST = 30.0
"""Pixels: residuals beyond are none of this camera's."""
PRIOR = np.array([0.5, 300.0, 300.0, 1.0])
"""Standard deviations: so weak that they only keep the problem solvable."""
LONGEST_STEP = np.array([0.1, 30.0, 30.0, 0.1])


@dataclass(frozen=True, eq=False)
class CameraOpinion:
    """What pairs say of the camera: log factor on the focal lengths, shift of the principal point in pixels (x, y),
    radial coefficient k1; float64 [4], zero means: as it was taken to be. covariance: float64 [4, 4] of these, from
    `blocks` independent ones. better: where asked for, share of the pairs that this camera fits better than the one
    they began with, each pose free; better_half: the same in that half of the time where it is largest.
    """

    value: np.ndarray
    covariance: np.ndarray
    blocks: int
    better: float = 1.0
    better_half: float = 1.0

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations, float64 [4]."""
        return np.sqrt(np.diag(self.covariance))

    def quantile(self, chance: float) -> float:
        """Standard deviations that a value exceeds by chance with this probability, either way (Student's t)."""
        return float(student_t.isf(chance / 2, self.blocks - PARAMETERS))


@dataclass(frozen=True, eq=False)
class CameraPair:
    """What two frames share: pixels before and after float64 [m, 2], depth before [m], pose, block of time."""

    before: np.ndarray
    after: np.ndarray
    depth: np.ndarray
    relative: np.ndarray
    block: int


def camera_of_pairs(
    pairs: Sequence[CameraPair], intrinsics: np.ndarray, compared: bool = False
) -> CameraOpinion | None:
    """Solve for the camera, starting at `intrinsics` and the pairs' poses; None where there are too few pairs.

    compared: say how many pairs it fits better, too, which takes longer than the solve.
    """
    kinds, block = np.unique([pair.block for pair in pairs], return_inverse=True)
    count = len(kinds)
    if len(pairs) < 2 * MIN_PAIRS or count < MIN_BLOCKS:
        return None
    points = _Points.of(pairs)
    value, poses, reduced = _solved(points, intrinsics)
    inverse = np.linalg.inv(reduced.normal.sum(0) + np.diag(1 / PRIOR**2))
    blocks = np.zeros((count, PARAMETERS))
    np.add.at(blocks, block, reduced.gradient)
    # Few blocks fit themselves: the usual correction of the sandwich.
    covariance = count / (count - PARAMETERS) * (inverse @ blocks.T @ blocks @ inverse)
    if not compared:
        return CameraOpinion(value, covariance, count)
    better = _costs(points, poses, value, intrinsics) < _costs(points, points.given, np.zeros(4), intrinsics)
    return CameraOpinion(value, covariance, count, float(np.mean(better)), _in_best_half(better, block))


def _in_best_half(better: np.ndarray, block: np.ndarray) -> float:
    """The largest share of `better` bool [n] in half of the blocks of time, in a row; block: int [n], from 0."""
    found, pairs = (np.bincount(block, weights) for weights in (better, None))
    half = (len(pairs) + 1) // 2
    inside = lambda values: np.convolve(values, np.ones(half), "valid")
    return float(np.max(inside(found) / inside(pairs)))


def _solved(points: _Points, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray, _Reduced]:
    """The camera, the poses, and the last step's equations."""
    value, poses = np.zeros(4), points.given
    reduced = _reduce(points, poses, value, intrinsics)
    for _ in range(ITERATIONS):
        normal = reduced.normal.sum(0) + np.diag(1 / PRIOR**2)
        step = np.clip(-np.linalg.solve(normal, reduced.gradient.sum(0)), -LONGEST_STEP, LONGEST_STEP)
        value = value + step
        poses = rigid.moved(poses, reduced.pose_steps(step))
        if np.all(np.abs(step) < SETTLED * LONGEST_STEP):
            break
        reduced = _reduce(points, poses, value, intrinsics)
    return value, poses, reduced


@dataclass(frozen=True, eq=False)
class _Points:
    """The matches of all pairs in a row. before, after: float64 [n, 2]. depth: [n]. pair: int [n], ascending. given:
    float64 [pairs, 4, 4], their poses.
    """

    before: np.ndarray
    after: np.ndarray
    depth: np.ndarray
    pair: np.ndarray
    given: np.ndarray

    @classmethod
    def of(cls, pairs: Sequence[CameraPair]) -> _Points:
        before, after = np.concatenate([pair.before for pair in pairs]), np.concatenate([pair.after for pair in pairs])
        number = np.repeat(np.arange(len(pairs)), [len(pair.depth) for pair in pairs])
        given = np.array([pair.relative for pair in pairs])
        return cls(before, after, np.concatenate([pair.depth for pair in pairs]), number, given)

    def of_pairs(self, own: slice) -> _Points:
        """Those of some pairs in a row."""
        start, end = np.searchsorted(self.pair, [own.start, own.stop])
        of = slice(start, end)
        return _Points(self.before[of], self.after[of], self.depth[of], self.pair[of] - own.start, self.given[own])

    def residuals(self, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Predicted minus seen pixels float64 [n, 2]; NaN behind a camera. poses: float64 [pairs, 4, 4]."""
        return self._carried(poses, value, intrinsics).pixels - self.after

    def _carried(self, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> _Carried:
        focal = intrinsics[:2] * np.exp(value[0])
        bent = (self.before - intrinsics[2:] - value[1:3]) / focal
        x = bent
        for _ in range(4):  # the inverse of the lens by fixed-point iteration, as OpenCV does it
            x = bent / _stretch(x, value[3])
        turns = poses[self.pair, :3, :3]
        local = np.column_stack([x, np.ones(len(x))]) * self.depth[:, None]
        points = (turns @ local[:, :, None])[:, :, 0] + poses[self.pair, :3, 3]
        z = np.where(points[:, 2] > 1e-3, points[:, 2], np.nan)
        y = points[:, :2] / z[:, None]
        return _Carried(bent, x, turns, points, z, y, y * _stretch(y, value[3]) * focal + intrinsics[2:] + value[1:3])

    def linearized(self, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals by a left tangent of the pose (translation first) and by the camera, and the
        residuals, float64 [n, 2, 6 + 4 + 1].
        """
        now = self._carried(poses, value, intrinsics)
        focal = intrinsics[:2] * np.exp(value[0])
        k1, doubled = value[3], 2.0 * value[3]
        square = lambda points: np.sum(points**2, 1, keepdims=True)
        # Before: how the ray moves with log f, cx, cy and k1, through the lens undone.
        rays = np.zeros((len(self.depth), 2, PARAMETERS))
        rays[:, :, 0] = -now.bent
        rays[:, 0, 1], rays[:, 1, 2] = -1.0 / focal
        rays[:, :, 3] = -now.x * square(now.x)
        along = doubled * now.x / (_stretch(now.x, k1) + doubled * square(now.x))  # Sherman and Morrison
        rays -= now.x[:, :, None] * np.einsum("ni,nik->nk", along, rays)[:, None]
        rays /= _stretch(now.x, k1)[:, None]
        # After: how the pixel moves with the point.
        onto = np.zeros((len(self.depth), 2, 3))
        onto[:, 0, 0] = onto[:, 1, 1] = 1.0
        onto[:, :, 2] = -now.y
        turned = np.einsum("ni,nij->nj", now.y, onto)
        onto = _stretch(now.y, k1)[:, None] * onto + doubled * now.y[:, :, None] * turned[:, None]
        onto *= (focal / now.z[:, None])[:, :, None]
        rows = np.empty((len(self.depth), 2, 6 + PARAMETERS + 1))
        rows[:, :, :3] = onto
        rows[:, :, 3:6] = np.cross(now.points[:, None], onto)
        rows[:, :, 6:10] = onto @ (now.turns[:, :, :2] @ rays) * self.depth[:, None, None]
        rows[:, :, 6] += now.y * _stretch(now.y, k1) * focal
        rows[:, 0, 7] += 1.0
        rows[:, 1, 8] += 1.0
        rows[:, :, 9] += now.y * square(now.y) * focal
        rows[:, :, 10] = now.pixels - self.after
        return rows


class _Carried(NamedTuple):
    """Pixels on their way to the other frame: on the plane at depth 1, bent by the lens and not [n, 2], turns of the
    pairs [n, 3, 3], points in the other camera [n, 3], their depth [n], on its plane and in its image [n, 2].
    """

    bent: np.ndarray
    x: np.ndarray
    turns: np.ndarray
    points: np.ndarray
    z: np.ndarray
    y: np.ndarray
    pixels: np.ndarray


def _stretch(points: np.ndarray, k1: float) -> np.ndarray:
    """The factor of the lens at points [n, 2] of the plane at depth 1, float64 [n, 1]."""
    return 1.0 + k1 * np.sum(points**2, 1, keepdims=True)


def _costs(points: _Points, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Robust cost of each pair with a camera, its pose brought to rest."""
    for _ in range(POSE_ITERATIONS):
        poses = rigid.moved(poses, _reduce(points, poses, value, intrinsics).pose_steps(np.zeros(4)))
    off = np.linalg.norm(points.residuals(poses, value, intrinsics), axis=1)
    off = np.where(np.isfinite(off), np.minimum(off, FARTHEST), FARTHEST)
    cost = np.where(off < HUBER, off**2 / 2, HUBER * (off - HUBER / 2))
    return np.bincount(points.pair, cost, len(poses))


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Of each pair: normal matrix [pairs, 4, 4] and gradient [pairs, 4] over the camera, the pose eliminated; and what
    brings the pose back.
    """

    normal: np.ndarray
    gradient: np.ndarray
    inverse: np.ndarray
    cross: np.ndarray
    own: np.ndarray

    def pose_steps(self, step: np.ndarray) -> np.ndarray:
        """The step of each pose that belongs to a step of the camera, tangents [pairs, 6]."""
        return -np.einsum("pij,pj->pi", self.inverse, self.own + self.cross @ step)


def _reduce(points: _Points, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> _Reduced:
    """All pairs, some at a time: what is computed of them stays in the cache of a core."""
    part = lambda own: _reduce_part(points.of_pairs(own), poses[own], value, intrinsics)
    parts = map_in_threads(part, (slice(start, start + AT_ONCE) for start in range(0, len(poses), AT_ONCE)))
    together = lambda field: np.concatenate([getattr(part, field.name) for part in parts])
    return _Reduced(*(together(field) for field in fields(_Reduced)))


def _reduce_part(points: _Points, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> _Reduced:
    rows = points.linearized(poses, value, intrinsics)
    size = np.linalg.norm(rows[:, :, 10], axis=1)
    good = np.isfinite(rows).all((1, 2)) & (size < FARTHEST)
    weight = np.where(good, np.minimum(HUBER / np.maximum(size, 1e-9), 1.0), 0.0)
    rows = np.where(good[:, None, None], rows, 0.0) * np.sqrt(weight)[:, None, None]
    ends = np.searchsorted(points.pair, np.arange(len(poses) + 1))
    flat = [rows[start:end].reshape(-1, 11) for start, end in pairwise(ends)]
    squares = np.array([own.T @ own for own in flat])  # Hessian and gradient, [pairs, 11, 11]
    hessian, gradient = squares[:, :10, :10], squares[:, :10, 10]
    inverse = np.linalg.inv(hessian[:, :6, :6] + 1e-6 * np.eye(6))
    cross, own = hessian[:, :6, 6:], gradient[:, :6]
    back = np.swapaxes(cross, 1, 2) @ inverse
    return _Reduced(
        hessian[:, 6:, 6:] - back @ cross, gradient[:, 6:] - np.einsum("pij,pj->pi", back, own), inverse, cross, own
    )
