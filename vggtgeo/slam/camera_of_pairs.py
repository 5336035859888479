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
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.stats import t as student_t

LEAST_PAIRS = 8
PARAMETERS = 4
LEAST_BLOCKS = PARAMETERS + 2
ITERATIONS, SETTLED = 20, 0.002
"""At most, and the step, in the longest ones, below which there are no more. Half the focal length is seven of these
away."""
POSE_ITERATIONS = 4
HUBER = 1.0
FARTHEST = 30.0
"""Pixels: residuals beyond are none of this camera's."""
PRIOR = np.array([0.5, 300.0, 300.0, 1.0])
"""Standard deviations: so weak that they only keep the problem solvable."""
LONGEST_STEP = np.array([0.1, 30.0, 30.0, 0.1])
POSE_STEPS = (1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5)
CAMERA_STEPS = (1e-5, 1e-2, 1e-2, 1e-5)
"""Of the numerical derivatives."""


@dataclass(frozen=True, eq=False)
class CameraOpinion:
    """What pairs say of the camera: log factor on the focal lengths, shift of the principal point in pixels (x, y),
    radial coefficient k1; float64 [4], zero means: as it was taken to be. covariance: float64 [4, 4] of these, from
    `blocks` independent ones. better: share of the pairs that this camera fits better than the one they began with,
    each pose free.
    """

    value: np.ndarray
    covariance: np.ndarray
    blocks: int
    better: float = 1.0

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


def camera_of_pairs(pairs: Sequence[CameraPair], intrinsics: np.ndarray) -> CameraOpinion | None:
    """Solve for the camera, starting at `intrinsics` and the pairs' poses; None where there are too few pairs."""
    kinds, block = np.unique([pair.block for pair in pairs], return_inverse=True)
    count = len(kinds)
    if len(pairs) < 2 * LEAST_PAIRS or count < LEAST_BLOCKS:
        return None
    value, poses = np.zeros(4), [pair.relative for pair in pairs]
    prior = np.diag(1 / PRIOR**2)
    reduced: list[_Reduced] = []
    for _ in range(ITERATIONS):
        reduced = [_reduce(pair, pose, value, intrinsics) for pair, pose in zip(pairs, poses, strict=True)]
        step = -np.linalg.solve(sum(r.normal for r in reduced) + prior, sum(r.gradient for r in reduced))
        step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        value = value + step
        poses = [_moved(pose, r.pose_step(step)) for pose, r in zip(poses, reduced, strict=True)]
        if np.all(np.abs(step) < SETTLED * LONGEST_STEP):
            break
    inverse = np.linalg.inv(sum(r.normal for r in reduced) + prior)
    blocks = np.zeros((count, PARAMETERS))
    np.add.at(blocks, block, np.array([r.gradient for r in reduced]))
    # Few blocks fit themselves: the usual correction of the sandwich.
    scale = count / (count - PARAMETERS)
    began = _costs(pairs, [pair.relative for pair in pairs], np.zeros(4), intrinsics)
    better = float(np.mean(_costs(pairs, poses, value, intrinsics) < began))
    return CameraOpinion(value, scale * (inverse @ blocks.T @ blocks @ inverse), count, better)


def _costs(
    pairs: Sequence[CameraPair], poses: Sequence[np.ndarray], value: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Robust cost of each pair with a camera, its pose brought to rest."""
    costs = []
    for pair, start in zip(pairs, poses, strict=True):
        pose = start
        for _ in range(POSE_ITERATIONS):
            pose = _moved(pose, _reduce(pair, pose, value, intrinsics).pose_step(np.zeros(4)))
        off = np.linalg.norm(_predict(pair.before, pair.depth, pose, value, intrinsics) - pair.after, axis=1)
        off = np.where(np.isfinite(off), np.minimum(off, FARTHEST), FARTHEST)
        costs.append(np.where(off < HUBER, off**2 / 2, HUBER * (off - HUBER / 2)).sum())
    return np.array(costs)


def _predict(
    before: np.ndarray, depth: np.ndarray, pose: np.ndarray, value: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    focal = intrinsics[:2] * np.exp(value[0])
    centre = intrinsics[2:] + value[1:3]
    bent = (before - centre) / focal
    x = bent
    for _ in range(4):  # the inverse of the lens by fixed-point iteration, as OpenCV does it
        x = bent / (1 + value[3] * (x**2).sum(1, keepdims=True))
    points = np.column_stack([x, np.ones(len(x))]) * depth[:, None] @ pose[:3, :3].T + pose[:3, 3]
    z = np.where(points[:, 2] > 1e-3, points[:, 2], np.nan)
    y = points[:, :2] / z[:, None]
    return np.asarray(y * (1 + value[3] * (y**2).sum(1, keepdims=True)) * focal + centre)


def _moved(pose: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    step = np.eye(4)
    step[:3, :3] = cv2.Rodrigues(tangent[3:])[0]
    step[:3, 3] = tangent[:3]
    return step @ pose


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Normal matrix [4, 4] and gradient [4] over the camera, the pose eliminated; and what brings the pose back."""

    normal: np.ndarray
    gradient: np.ndarray
    inverse: np.ndarray
    cross: np.ndarray
    own: np.ndarray

    def pose_step(self, step: np.ndarray) -> np.ndarray:
        """The pose's step that belongs to a step of the camera, tangent [6]."""
        return np.asarray(-self.inverse @ (self.own + self.cross @ step))


def _reduce(pair: CameraPair, pose: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> _Reduced:
    def at(tangent: np.ndarray, camera: np.ndarray) -> np.ndarray:
        return (_predict(pair.before, pair.depth, _moved(pose, tangent), camera, intrinsics) - pair.after).ravel()

    zero = np.zeros(6)
    residual = at(zero, value)
    columns = [(at(h * row, value) - residual) / h for h, row in zip(POSE_STEPS, np.eye(6), strict=True)]
    columns += [(at(zero, value + h * row) - residual) / h for h, row in zip(CAMERA_STEPS, np.eye(4), strict=True)]
    jacobian = np.column_stack(columns)
    sizes = np.repeat(np.linalg.norm(residual.reshape(-1, 2), axis=1), 2)
    good = np.isfinite(residual) & np.isfinite(jacobian).all(1) & (sizes < FARTHEST)
    jacobian, residual = jacobian[good], residual[good]
    weight = np.minimum(HUBER / np.maximum(sizes[good], 1e-9), 1.0)
    hessian = jacobian.T @ (weight[:, None] * jacobian)
    gradient = jacobian.T @ (weight * residual)
    inverse = np.linalg.inv(hessian[:6, :6] + 1e-6 * np.eye(6))
    cross = hessian[:6, 6:]
    normal = hessian[6:, 6:] - cross.T @ inverse @ cross
    return _Reduced(normal, gradient[6:] - cross.T @ inverse @ gradient[:6], inverse, cross, gradient[:6])
