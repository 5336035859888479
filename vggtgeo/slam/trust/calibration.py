"""The camera against the images: does what was given explain where corners with depth are seen?

For pairs of frames a few steps apart, the corners `p` with the sensor's depth are carried to the other frame,
`q = distort(pi(T pi^-1(undistort(p), z)))`, and the relative pose `T` of each pair is solved together with four
parameters of the camera that all pairs share: a factor on the focal lengths, the shift of the principal point, and the
first radial coefficient `k1`. Gauss-Newton with Huber weights; the poses are eliminated pair by pair (Schur), so it is
a bundle adjustment whose depths are the sensor's. The covariance is the sandwich over pairs,
`S^-1 (sum g_p g_p') S^-1`, which needs no noise model: pairs are independent, corners of a pair need not be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, common
from vggtgeo.slam.trust.finding import Finding

GAP = 4
MOST_PAIRS = 120
LEAST_PAIRS = 8
LEAST_CORNERS = 15
ITERATIONS = 4
HUBER = 1.0
"""Pixels."""
SIGMAS = 5.0
"""How sure a deviation must be to be told."""
MOST_FOCAL = 0.04
"""Relative. Healthy clips: 0.03 at most, which the depth's own scale and the registration of depth and colour leave."""
MOST_SHIFT = 0.03
"""Of the principal point, in image widths."""
MOST_WARP = 0.015
"""Of the corners, in image diagonals."""


@dataclass(frozen=True, eq=False)
class CameraOpinion:
    """What the corners say of the camera, and how surely: log factor on the focal lengths, shift of the principal point
    in pixels (x, y), radial coefficient k1; float64 [4] each. Zero means: as given.
    """

    value: np.ndarray
    sigma: np.ndarray
    pairs: int


def camera_opinion(estimate: Estimate, evidence: Evidence, intrinsics: np.ndarray) -> CameraOpinion | None:
    """Solve for the camera, starting at `intrinsics` and the run's poses; None where there is too little to see."""
    pairs = _pairs(estimate, evidence)
    if len(pairs) < LEAST_PAIRS:
        return None
    value = np.zeros(4)
    poses = [pair[3] for pair in pairs]
    for _ in range(ITERATIONS):
        normal, gradients, solves = np.zeros((4, 4)), [], []
        for (before, after, depth, _), pose in zip(pairs, poses, strict=True):
            reduced, gradient, solve = _reduced(before, after, depth, pose, value, intrinsics)
            normal += reduced
            gradients.append(gradient)
            solves.append(solve)
        prior = np.diag(1 / np.array([0.5, 300.0, 300.0, 1.0]) ** 2)
        step = -np.linalg.solve(normal + prior, np.sum(gradients, 0))
        step = np.clip(step, -np.array([0.1, 30, 30, 0.1]), np.array([0.1, 30, 30, 0.1]))
        value = value + step
        poses = [_moved(pose, solve(step)) for pose, solve in zip(poses, solves, strict=True)]
    inverse = np.linalg.inv(normal + prior)
    spread = np.array(gradients).T @ np.array(gradients)
    return CameraOpinion(value, np.sqrt(np.diag(inverse @ spread @ inverse)), len(pairs))


def check_camera(estimate: Estimate, opinion: CameraOpinion | None, size: tuple[int, int]) -> list[Finding]:
    """Deviations of the camera that the run ends with that are sure and large; size: width and height, pixels.

    opinion: found with the given intrinsics. Those of a run that has moved to where the images want them are no fault.
    """
    if opinion is None or not estimate.calibrated:
        return []
    found = []
    taken = np.array(
        [np.log(estimate.intrinsics[:2] / estimate.given[:2]).mean(), *(estimate.intrinsics - estimate.given)[2:]]
    )
    focal, x, y = off = opinion.value[:3] - taken
    sure = np.abs(off) > SIGMAS * opinion.sigma[:3]
    if sure[0] and abs(focal) > MOST_FOCAL:
        wanted = float(np.exp(focal) * estimate.intrinsics[0])
        text = f"the images want a focal length of {wanted:.0f} px; the run has {estimate.intrinsics[0]:.0f}"
        found.append(Finding("calibration", "degraded", text))
    if (sure[1] and abs(x) > MOST_SHIFT * size[0]) or (sure[2] and abs(y) > MOST_SHIFT * size[0]):
        text = f"the images want the principal point {x:.0f}, {y:.0f} px beside where it is taken to be"
        found.append(Finding("calibration", "degraded", text))
    radial = float(opinion.value[3])
    diagonal, focal_length = float(np.hypot(*size)), float(estimate.given[0])
    warp = abs(radial) * (diagonal / 2 / focal_length) ** 3 * focal_length
    if abs(radial) > SIGMAS * opinion.sigma[3] and warp > MOST_WARP * diagonal:
        text = (
            f"the images are distorted (k1 about {radial:.2f}, {warp:.0f} px in the corners), and the calibration does "
            "not say so"
        )
        found.append(Finding("calibration", "degraded", text))
    return found


def _pairs(estimate: Estimate, evidence: Evidence) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    found = []
    starts = np.unique(np.linspace(0, max(len(evidence) - GAP - 1, 0), MOST_PAIRS).astype(int))
    for row in starts:
        if row + GAP >= len(evidence) or not (estimate.tracked[row] and estimate.tracked[row + GAP]):
            continue
        first, second = evidence[row], evidence[row + GAP]
        rows, others = common(first, second)
        depth = first.depth[rows].astype(np.float64)
        known = np.isfinite(depth) & (depth > 0)
        if np.count_nonzero(known) < LEAST_CORNERS:
            continue
        relative = estimate.poses[row + GAP] @ rigid.invert(estimate.poses[row])
        before, after = first.pixels[rows][known], second.pixels[others][known]
        found.append((before.astype(np.float64), after.astype(np.float64), depth[known], relative))
    return found


def _predict(
    before: np.ndarray, depth: np.ndarray, pose: np.ndarray, value: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    focal = intrinsics[:2] * np.exp(value[0])
    centre = intrinsics[2:] + value[1:3]
    x = (before - centre) / focal
    x = x / (1 + value[3] * (x**2).sum(1, keepdims=True))
    points = np.column_stack([x, np.ones(len(x))]) * depth[:, None] @ pose[:3, :3].T + pose[:3, 3]
    z = np.where(points[:, 2] > 1e-3, points[:, 2], np.nan)
    y = points[:, :2] / z[:, None]
    return np.asarray(y * (1 + value[3] * (y**2).sum(1, keepdims=True)) * focal + centre)


def _moved(pose: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(tangent[3:]).as_matrix()
    step[:3, 3] = tangent[:3]
    return step @ pose


def _reduced(before, after, depth, pose, value, intrinsics):  # type: ignore[no-untyped-def]
    """Normal matrix and gradient over the camera with the pose eliminated, and the pose's step for a camera step."""
    at = lambda pose_, value_: (_predict(before, depth, pose_, value_, intrinsics) - after).ravel()
    residual = at(pose, value)
    columns = []
    for k, h in enumerate((1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5)):
        step = np.zeros(6)
        step[k] = h
        columns.append((at(_moved(pose, step), value) - residual) / h)
    for k, h in enumerate((1e-5, 1e-2, 1e-2, 1e-5)):
        step = np.zeros(4)
        step[k] = h
        columns.append((at(pose, value + step) - residual) / h)
    jacobian = np.column_stack(columns)
    sizes = np.repeat(np.linalg.norm(residual.reshape(-1, 2), axis=1), 2)
    good = np.isfinite(residual) & np.isfinite(jacobian).all(1)
    weight = np.where(sizes < HUBER, 1.0, HUBER / np.maximum(sizes, HUBER)) * (sizes < 30)
    jacobian, residual, weight = jacobian[good], residual[good], weight[good]
    hessian = jacobian.T @ (weight[:, None] * jacobian)
    gradient = jacobian.T @ (weight * residual)
    own = hessian[:6, :6] + 1e-6 * np.eye(6)
    inverse = np.linalg.inv(own)
    cross = hessian[6:, :6] @ inverse
    return (
        hessian[6:, 6:] - cross @ hessian[:6, 6:],
        gradient[6:] - cross @ gradient[:6],
        lambda step: -inverse @ (gradient[:6] + hessian[:6, 6:] @ step),
    )
