"""The camera against the images: does what was given explain where corners with depth are seen?

For pairs of frames `GAP` apart, in both directions, the corners `p` with the sensor's depth are carried to the other
frame, `q = distort(pi(T pi^-1(undistort(p), z)))`, and the relative pose `T` of each pair is solved together with four
parameters of the camera that all pairs share: a factor on the focal lengths, the shift of the principal point, and the
first radial coefficient `k1`. Gauss-Newton with Huber weights; the poses are eliminated pair by pair (Schur), so it is
a bundle adjustment whose depths are the sensor's. Errors of these depths pull the focal length one way where the camera
goes forward and the other way where it goes back; both directions together cancel most of it.

The covariance is the sandwich over blocks of time, `S^-1 (sum g_b g_b') S^-1`: it needs no noise model, and
neighbouring pairs may share corners.

With the true poses, in pieces of 60 frames of corridor-office, building-walk and redkitchen, undisturbed: focal length
-5.5 to +1 %, principal point within 20 px, k1 -0.045 (redkitchen, whose lens has about that) to +0.02. With a
calibration 20 % off: 17 to 20 %; cut by an eighth on each side: 78 px (67 are true); k1 = -0.25: -0.22 to -0.27.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, common
from vggtgeo.slam.trust.finding import Finding

GAP = 2
MOST_PAIRS = 60
LEAST_PAIRS = 8
LEAST_CORNERS = 15
LEAST_FLOW = 3.0
"""Pixels: a camera that stands still says nothing of its lens."""
BLOCK = 5
"""Frames in a block of time."""
ITERATIONS = 6
HUBER = 1.0
FARTHEST = 30.0
"""Pixels: residuals beyond are none of this camera's."""
PRIOR = np.array([0.5, 300.0, 300.0, 1.0])
"""Standard deviations: so weak that they only keep the problem solvable."""
LONGEST_STEP = np.array([0.1, 30.0, 30.0, 0.1])
POSE_STEPS = (1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5)
CAMERA_STEPS = (1e-5, 1e-2, 1e-2, 1e-5)
"""Of the numerical derivatives."""
SIGMAS = 5.0
"""How sure a deviation must be to be told."""
MOST_MOVED = 0.05
"""Of the focal length: how far a run may move the camera to count as settled. Healthy ones moved it by at most 3.8 %
with a loose prior, and by less than 1 % with the one that holds it."""
MOST_FOCAL = 0.08
"""Relative."""
MOST_SHIFT = 0.05
"""Of the principal point, in image widths."""
MOST_WARP = 0.02
"""Of the corners, in image diagonals."""


@dataclass(frozen=True, eq=False)
class CameraOpinion:
    """What the corners say of the camera, and how surely: log factor on the focal lengths, shift of the principal point
    in pixels (x, y), radial coefficient k1; float64 [4] each. Zero means: as it was taken to be.
    """

    value: np.ndarray
    sigma: np.ndarray
    pairs: int


def camera_opinion(estimate: Estimate, evidence: Evidence) -> CameraOpinion | None:
    """Solve for the camera, starting at that of the run and its poses; None where there is too little to see."""
    pairs = _pairs(estimate, evidence)
    if len(pairs) < 2 * LEAST_PAIRS:
        return None
    value, poses = np.zeros(4), [pair.relative for pair in pairs]
    intrinsics = estimate.intrinsics
    prior = np.diag(1 / PRIOR**2)
    reduced: list[_Reduced] = []
    for _ in range(ITERATIONS):
        reduced = [_reduce(pair, pose, value, intrinsics) for pair, pose in zip(pairs, poses, strict=True)]
        step = -np.linalg.solve(sum(r.normal for r in reduced) + prior, sum(r.gradient for r in reduced))
        step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        value = value + step
        poses = [_moved(pose, r.pose_step(step)) for pose, r in zip(poses, reduced, strict=True)]
    inverse = np.linalg.inv(sum(r.normal for r in reduced) + prior)
    blocks = np.zeros((1 + max(pair.block for pair in pairs), 4))
    np.add.at(blocks, [pair.block for pair in pairs], np.array([r.gradient for r in reduced]))
    return CameraOpinion(value, np.sqrt(np.diag(inverse @ blocks.T @ blocks @ inverse)), len(pairs))


def check_camera(estimate: Estimate, opinion: CameraOpinion | None, size: tuple[int, int]) -> list[Finding]:
    """Deviations of the camera that the run ends with that are sure and large; size: width and height, pixels.

    opinion: found with the intrinsics at the end of the run. Those of a run that has moved from a wrong calibration to
    where the images want them are no fault; but whoever was that far off must have settled better than others.
    """
    if opinion is None or not estimate.calibrated:
        return []
    found = []
    focal, x, y, radial = (float(value) for value in opinion.value)
    moved = bool(np.any(np.abs(estimate.intrinsics - estimate.given) > MOST_MOVED * estimate.given[0]))
    sure = np.abs(opinion.value) > (0.8 if moved else 1.0) * SIGMAS * opinion.sigma
    much = 0.5 if moved else 1.0
    if sure[0] and abs(focal) > much * MOST_FOCAL:
        wanted = float(np.exp(focal) * estimate.intrinsics[0])
        text = f"the images want a focal length of {wanted:.0f} px; the run has {estimate.intrinsics[0]:.0f}"
        found.append(Finding("calibration", "degraded", text))
    if (sure[1] and abs(x) > much * MOST_SHIFT * size[0]) or (sure[2] and abs(y) > much * MOST_SHIFT * size[0]):
        text = f"the images want the principal point {x:.0f}, {y:.0f} px beside where it is taken to be"
        found.append(Finding("calibration", "degraded", text))
    diagonal, focal_length = float(np.hypot(*size)), float(estimate.intrinsics[0])
    warp = abs(radial) * (diagonal / 2 / focal_length) ** 3 * focal_length
    if sure[3] and warp > MOST_WARP * diagonal:
        text = (
            f"the images are distorted (k1 about {radial:.2f}, {warp:.0f} px in the corners), and the calibration does "
            "not say so"
        )
        found.append(Finding("calibration", "degraded", text))
    return found


@dataclass(frozen=True, eq=False)
class _Pair:
    """Corners of two frames: pixels before and after float64 [m, 2], depth before [m], pose, block of time."""

    before: np.ndarray
    after: np.ndarray
    depth: np.ndarray
    relative: np.ndarray
    block: int


def _pairs(estimate: Estimate, evidence: Evidence) -> list[_Pair]:
    spread = np.unique(np.linspace(0, max(len(evidence) - GAP - 1, 0), MOST_PAIRS).astype(int))
    starts = [int(row) for row in spread if row + GAP < len(evidence)]
    pairs = [(row, row + GAP) for row in starts] + [(row + GAP, row) for row in starts]
    found = []
    for row, other in pairs:
        if not (estimate.tracked[row] and estimate.tracked[other]):
            continue
        first, second = evidence[row], evidence[other]
        rows, others = common(first, second)
        depth = first.depth[rows].astype(np.float64)
        known = np.isfinite(depth) & (depth > 0)
        if np.count_nonzero(known) < LEAST_CORNERS:
            continue
        before, after = (pixels[known].astype(np.float64) for pixels in (first.pixels[rows], second.pixels[others]))
        if np.median(np.linalg.norm(after - before, axis=1)) < LEAST_FLOW:
            continue
        relative = estimate.poses[other] @ rigid.invert(estimate.poses[row])
        found.append(_Pair(before, after, depth[known], relative, min(row, other) // BLOCK))
    return found


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
    step[:3, :3] = Rotation.from_rotvec(tangent[3:]).as_matrix()
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


def _reduce(pair: _Pair, pose: np.ndarray, value: np.ndarray, intrinsics: np.ndarray) -> _Reduced:
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
