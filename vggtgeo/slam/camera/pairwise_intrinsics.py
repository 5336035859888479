"""Intrinsics estimated from pairs of images with known depth: focal length, principal point and distortion.

For pairs of frames, in both directions, pixels `p` with known depth are carried to the other
frame, `q = distort(pi(T pi^-1(undistort(p), z)))`, and the relative pose `T` of each pair is solved together with four
parameters of the camera that all pairs share: a factor on the focal lengths, the shift of the principal point, and the
first radial coefficient `k1`. Gauss-Newton with Huber weights; the poses are eliminated pair by pair (Schur), so it is
a bundle adjustment whose depths are given. Errors of these depths pull the focal length one way where the camera
goes forward and the other way where it goes back; both directions together cancel most of it.

The covariance is the sandwich over `B` blocks of time, `B / (B - 4) S^-1 (sum g_b g_b') S^-1`: it needs no noise model,
and neighbouring pairs may share their errors. `k1` is always free: if distortion is left out, the focal length absorbs
it (`benchmarks/no_calibration.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import inverse_information
from vggtgeo.slam.threads import BATCH, map_in_threads

MIN_PAIRS = 8
"""Half of the minimum number of pairs: each half determines the parameters, with two pairs for each of them."""
PARAMETERS = 4
"""Logarithm of the focal length, principal point, k1."""
MIN_BLOCKS = PARAMETERS + 2
"""Minimum number of blocks: the covariance between them needs degrees of freedom beyond the parameters."""
ITERATIONS, CONVERGED = 20, 0.002
"""Iteration limit, and the step, as a share of the longest one, that ends the iteration. Half the focal length is seven
of the longest steps away, and the step that ends it, 0.02 % of the focal length, is far below its noise."""
HUBER = 1.0
"""Width of the kernel, pixels: the noise of a match."""
MAX_RESIDUAL = 30.0
"""Pixels: larger residuals are outliers and have no weight. A guess that is 30 % off moves a match that has moved by
100 pixels this far."""
LONGEST_CHANGE = 0.1
"""Longest step of an iteration, in which the linearisation holds: of the logarithm of the focal length, and of k1."""
LONGEST_STEP = np.array([LONGEST_CHANGE, MAX_RESIDUAL, MAX_RESIDUAL, LONGEST_CHANGE])
"""The same of all parameters; a longer step in pixels would make outliers of all matches."""
PRIOR = 10 * LONGEST_STEP
"""Standard deviations: so weak that they only keep the problem solvable."""


@dataclass(frozen=True, eq=False)
class PairwiseIntrinsics:
    """The estimate: change of the intrinsics against those that it started from.

    value: float64 [4], log factor on the focal lengths, shift of the principal point (x, y, pixels), coefficient k1.
    covariance: float64 [4, 4], from independent blocks of time.
    """

    value: np.ndarray
    covariance: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations, float64 [4]."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class CameraPair:
    """Matches of two frames: pixels before and after float64 [m, 2], depth before [m], relative pose, block of time."""

    before: np.ndarray
    after: np.ndarray
    depth: np.ndarray
    relative: np.ndarray
    block: int


def pairwise_intrinsics(pairs: Sequence[CameraPair], intrinsics: np.ndarray) -> PairwiseIntrinsics | None:
    """Estimate the intrinsics, starting at `intrinsics` and the pairs' poses; return None for too few pairs."""
    kinds, block = np.unique([pair.block for pair in pairs], return_inverse=True)
    count = len(kinds)
    if len(pairs) < 2 * MIN_PAIRS or count < MIN_BLOCKS:
        return None
    points = _Points.of(pairs)
    value, reduced = _solved(points, intrinsics)
    inverse = np.linalg.inv(reduced.normal.sum(0) + np.diag(1 / PRIOR**2))
    blocks = np.zeros((count, PARAMETERS))
    np.add.at(blocks, block, reduced.gradient)
    # Correct the sandwich for the degrees of freedom that the fit takes from few blocks.
    covariance = count / (count - PARAMETERS) * (inverse @ blocks.T @ blocks @ inverse)
    return PairwiseIntrinsics(value, covariance)


def _solved(points: _Points, intrinsics: np.ndarray) -> tuple[np.ndarray, _Reduced]:
    """Return the intrinsics, and the normal equations of the last step."""
    value, poses = np.zeros(4), points.given
    reduced = _reduce(points, poses, value, intrinsics)
    # Not `gauss_newton`: bounded steps need no energy, which would take another 0.04 s beside 0.12 s for 500 pairs.
    for _ in range(ITERATIONS):
        normal = reduced.normal.sum(0) + np.diag(1 / PRIOR**2)
        step = np.clip(-np.linalg.solve(normal, reduced.gradient.sum(0)), -LONGEST_STEP, LONGEST_STEP)
        value = value + step
        poses = rigid.moved(poses, reduced.pose_steps(step))
        if np.all(np.abs(step) < CONVERGED * LONGEST_STEP):
            break
        reduced = _reduce(points, poses, value, intrinsics)
    return value, reduced


@dataclass(frozen=True, eq=False)
class _Points:
    """The matches of all pairs, concatenated. before, after: float64 [n, 2]. depth: [n]. pair: int [n], ascending.
    given: float64 [pairs, 4, 4], their poses.
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
        """Return the matches of a range of pairs."""
        start, end = np.searchsorted(self.pair, [own.start, own.stop])
        of = slice(start, end)
        return _Points(self.before[of], self.after[of], self.depth[of], self.pair[of] - own.start, self.given[own])

    def _carried(self, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> _Carried:
        focal = intrinsics[:2] * np.exp(value[0])
        bent = (self.before - intrinsics[2:] - value[1:3]) / focal
        x = bent
        for _ in range(4):  # the inverse of the lens by fixed-point iteration, as OpenCV does it
            x = bent / _stretch(x, value[3])
        turns = poses[self.pair, :3, :3]
        local = np.column_stack([x, np.ones(len(x))]) * self.depth[:, None]
        points = (turns @ local[:, :, None])[:, :, 0] + poses[self.pair, :3, 3]
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        y = points[:, :2] / z[:, None]
        return _Carried(bent, x, turns, points, z, y, y * _stretch(y, value[3]) * focal + intrinsics[2:] + value[1:3])

    def linearized(self, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Return derivatives of the residuals by a left tangent of the pose (translation first) and by the camera, and
        the residuals (predicted minus observed pixels), float64 [n, 2, 6 + 4 + 1]; NaN behind a camera.
        """
        now = self._carried(poses, value, intrinsics)
        focal = intrinsics[:2] * np.exp(value[0])
        k1, doubled = value[3], 2.0 * value[3]
        square = lambda points: np.sum(points**2, 1, keepdims=True)
        # First frame: derivative of the undistorted ray by log f, cx, cy and k1.
        rays = np.zeros((len(self.depth), 2, PARAMETERS))
        rays[:, :, 0] = -now.bent
        rays[:, 0, 1], rays[:, 1, 2] = -1.0 / focal
        rays[:, :, 3] = -now.x * square(now.x)
        along = doubled * now.x / (_stretch(now.x, k1) + doubled * square(now.x))  # Sherman and Morrison
        rays -= now.x[:, :, None] * np.einsum("ni,nik->nk", along, rays)[:, None]
        rays /= _stretch(now.x, k1)[:, None]
        # Second frame: derivative of the pixel by the point.
        onto = np.zeros((len(self.depth), 2, 3))
        onto[:, 0, 0] = onto[:, 1, 1] = 1.0
        onto[:, :, 2] = -now.y
        turned = np.einsum("ni,nij->nj", now.y, onto)
        onto = _stretch(now.y, k1)[:, None] * onto + doubled * now.y[:, :, None] * turned[:, None]
        onto *= (focal / now.z[:, None])[:, :, None]
        rows = np.empty((len(self.depth), 2, 6 + PARAMETERS + 1))
        rows[:, :, :3] = onto
        rows[:, :, 3:6] = np.cross(now.points[:, None], onto)
        rows[:, :, 6:-1] = onto @ (now.turns[:, :, :2] @ rays) * self.depth[:, None, None]
        rows[:, :, 6] += now.y * _stretch(now.y, k1) * focal
        rows[:, 0, 7] += 1.0
        rows[:, 1, 8] += 1.0
        rows[:, :, -2] += now.y * square(now.y) * focal
        rows[:, :, -1] = now.pixels - self.after
        return rows


class _Carried(NamedTuple):
    """Intermediate values of the projection: normalised points, distorted (`bent`) and not [n, 2], rotations [n, 3, 3],
    points in the other camera [n, 3], their depth [n], their normalised points and pixels there [n, 2].
    """

    bent: np.ndarray
    x: np.ndarray
    turns: np.ndarray
    points: np.ndarray
    z: np.ndarray
    y: np.ndarray
    pixels: np.ndarray


def _stretch(points: np.ndarray, k1: float) -> np.ndarray:
    """Return the radial distortion factor at points [n, 2] (normalised), float64 [n, 1]."""
    return 1.0 + k1 * np.sum(points**2, 1, keepdims=True)


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Schur complement of each pair over the intrinsics, matrix [pairs, 4, 4] and gradient [pairs, 4], and what the
    back-substitution of its pose needs.
    """

    normal: np.ndarray
    gradient: np.ndarray
    inverse: np.ndarray
    cross: np.ndarray
    own: np.ndarray

    def pose_steps(self, step: np.ndarray) -> np.ndarray:
        """Return the step of each pose for a step of the intrinsics, tangents [pairs, 6] (back-substitution)."""
        return -np.einsum("pij,pj->pi", self.inverse, self.own + self.cross @ step)


def _reduce(points: _Points, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> _Reduced:
    """Reduce all pairs in batches that fit the cache of a core."""
    part = lambda own: _reduce_part(points.of_pairs(own), poses[own], value, intrinsics)
    parts = map_in_threads(part, (slice(start, start + BATCH) for start in range(0, len(poses), BATCH)))
    together = lambda field: np.concatenate([getattr(part, field.name) for part in parts])
    return _Reduced(*(together(field) for field in fields(_Reduced)))


def _reduce_part(points: _Points, poses: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> _Reduced:
    rows = points.linearized(poses, value, intrinsics)
    size = np.linalg.norm(rows[:, :, -1], axis=1)
    good = np.isfinite(rows).all((1, 2)) & (size < MAX_RESIDUAL)
    weight = np.where(good, HUBER / np.maximum(size, HUBER), 0.0)
    rows = np.where(good[:, None, None], rows, 0.0) * np.sqrt(weight)[:, None, None]
    ends = np.searchsorted(points.pair, np.arange(len(poses) + 1))
    flat = [rows[start:end].reshape(-1, rows.shape[-1]) for start, end in pairwise(ends)]
    squares = np.array([own.T @ own for own in flat])  # Hessian and gradient, [pairs, 11, 11]
    hessian, gradient = squares[:, :-1, :-1], squares[:, :-1, -1]
    inverse = inverse_information(hessian[:, :6, :6])
    cross, own = hessian[:, :6, 6:], gradient[:, :6]
    back = np.swapaxes(cross, 1, 2) @ inverse
    return _Reduced(
        hessian[:, 6:, 6:] - back @ cross, gradient[:, 6:] - np.einsum("pij,pj->pi", back, own), inverse, cross, own
    )
