"""Two-view initialization without depth: relative motion and structure up to scale."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from vggtgeo.models.classical.verification import SampleOrder
from vggtgeo.models.roles import GeometryResult, StartGuess

from vggtgeo.geometry import pinhole


@dataclass(frozen=True)
class TwoViewStart:
    """Essential matrix by MAGSAC++, choice among its four motions by points in front, triangulation.

    Two motions explain the points of a plane (Longuet-Higgins, 1986), and noise decides between them. So if a motion of
    a plane in another direction explains nearly as many matches, initialization waits for another pair, as in ORB-SLAM
    (Mur-Artal, Montiel, Tardos, 2015). Measured: the rival explained 0.46 to 0.53 of the matches in correct starts, and
    0.99 to 1.05 in wrong ones; its direction differed by 27 to 109 degrees in wrong ones, by 1 to 10 in correct ones.

    threshold: maximum epipolar error of an inlier, pixels. least: minimum number of points; starts of about 50 points
    were often wrong, and a start can wait for a better pair. parallax: minimum median angle between the rays of a
    point, radians; below it depth is mostly noise. rival: share of the matches from which another motion makes the
    result ambiguous; elsewhere: minimum angle between the directions of both, radians.
    """

    threshold: float = 1.5
    least: int = 60
    parallax: float = float(np.deg2rad(2.0))
    confidence: float = 0.9999
    max_iterations: int = 5000
    rival: float = 0.8
    elsewhere: float = float(np.deg2rad(15.0))
    order: SampleOrder = field(default_factory=SampleOrder)

    def start(self, pixels_i: np.ndarray, pixels_j: np.ndarray, intrinsics: np.ndarray) -> StartGuess:
        """Return motion and structure from matches float [n, 2] each; see `InitialGeometry.start`."""
        if len(pixels_i) < self.least:
            return _failed(len(pixels_i), GeometryResult.TOO_FEW_MATCHES)
        rays_i, rays_j = _rays(pixels_i, intrinsics), _rays(pixels_j, intrinsics)
        settings = (cv2.USAC_MAGSAC, self.confidence, self.threshold, self.max_iterations)
        matrix = pinhole.matrix(intrinsics)
        essential, agrees = self.order.estimate(cv2.findEssentialMat, pixels_i, pixels_j, matrix, *settings)
        # For degenerate points there may be several matrices, stacked.
        if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
            return _failed(len(pixels_i), GeometryResult.DEGENERATE)
        pose = _motion(essential, rays_i[agrees], rays_j[agrees])
        points, inliers = _triangulate(pose, rays_i, rays_j, agrees)
        if np.count_nonzero(inliers) < self.least:
            turned = self._only_turned(rays_i[agrees], rays_j[agrees], intrinsics)
            reason = GeometryResult.LOW_PARALLAX if turned else GeometryResult.TOO_FEW_INLIERS
            return _failed(len(pixels_i), reason)
        angle = median_parallax(points[inliers], pose)
        if angle < self.parallax or self._only_turned(rays_i[inliers], rays_j[inliers], intrinsics):
            return StartGuess(pose, points, inliers, angle, GeometryResult.LOW_PARALLAX)
        if self._has_rival(pose, pixels_i, pixels_j, intrinsics):
            return StartGuess(pose, points, inliers, angle, GeometryResult.AMBIGUOUS)
        return StartGuess(pose, points, inliers, angle, GeometryResult.SUCCESS)

    def _has_rival(self, pose: np.ndarray, pixels_i: np.ndarray, pixels_j: np.ndarray, intrinsics: np.ndarray) -> bool:
        """Return whether a plane's motion in another direction explains nearly as many matches."""
        explained = lambda motion: np.count_nonzero(
            pinhole.epipolar_distance(pixels_i, pixels_j, motion, intrinsics) < self.threshold
        )
        needed = self.rival * explained(pose)
        rivals = self._motions_of_a_plane(pixels_i, pixels_j, intrinsics)
        far = (motion for motion in rivals if _direction_between(motion, pose) > self.elsewhere)
        return any(explained(motion) >= needed for motion in far)

    def _motions_of_a_plane(
        self, pixels_i: np.ndarray, pixels_j: np.ndarray, intrinsics: np.ndarray
    ) -> list[np.ndarray]:
        """Return the motions, at most two, of the homography of most matches whose plane is in front of the camera."""
        settings = (cv2.USAC_MAGSAC, self.threshold, None, self.max_iterations, self.confidence)
        homography, agrees = self.order.estimate(cv2.findHomography, pixels_i, pixels_j, *settings)
        if homography is None:
            return []
        _, *found = cv2.decomposeHomographyMat(homography, pinhole.matrix(intrinsics))
        rays = pinhole.rays(np.asarray(pixels_i[agrees], np.float64), intrinsics)
        motions = []
        for rotation, translation, normal in zip(*found, strict=True):
            in_front = np.count_nonzero(rays @ normal.ravel() > 0) > 0.5 * len(rays)
            if in_front and np.linalg.norm(translation) > 1e-6:
                motions.append(np.eye(4))
                motions[-1][:3, :3], motions[-1][:3, 3] = rotation, translation.ravel()
        return motions

    def _only_turned(self, rays_i: np.ndarray, rays_j: np.ndarray, intrinsics: np.ndarray) -> bool:
        """Return whether a rotation alone maps half of the rays of i onto those of j to within the threshold."""
        if len(rays_i) < 3:
            return False
        rotation = _rotation_between(rays_i, rays_j)
        off = np.arccos(np.clip(((rays_i @ rotation.T) * rays_j).sum(axis=1), -1.0, 1.0))
        return bool(np.median(off) * float(intrinsics[0]) < self.threshold)


def _direction_between(first: np.ndarray, second: np.ndarray) -> float:
    """Return angle between the translations of two motions, radians."""
    one, other = first[:3, 3], second[:3, 3]
    cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _rays(pixels: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    rays = pinhole.rays(pixels, intrinsics)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _motion(essential: np.ndarray, rays_i: np.ndarray, rays_j: np.ndarray) -> np.ndarray:
    """Return the motion of an essential matrix that places most points in front of both cameras."""
    rotation_1, rotation_2, translation = cv2.decomposeEssentialMat(essential)
    candidates = []
    for rotation in (rotation_1, rotation_2):
        for sign in (1.0, -1.0):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, sign * translation.ravel()
            depth_i, depth_j = _depths_along(pose, rays_i, rays_j)
            candidates.append((np.count_nonzero((depth_i > 0) & (depth_j > 0)), pose))
    return max(candidates, key=lambda candidate: candidate[0])[1]


def _depths_along(pose: np.ndarray, rays_i: np.ndarray, rays_j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances along the two rays to their closest approach: least squares of s_j f_j = s_i R f_i + t."""
    turned, translation = rays_i @ pose[:3, :3].T, pose[:3, 3]
    cosine = (turned * rays_j).sum(axis=1)
    along_i, along_j = turned @ translation, rays_j @ translation
    determinant = np.maximum(1.0 - cosine * cosine, 1e-12)
    depth_i = (cosine * along_j - along_i) / determinant
    depth_j = (along_j - cosine * along_i) / determinant
    return depth_i, depth_j


def _triangulate(
    pose: np.ndarray, rays_i: np.ndarray, rays_j: np.ndarray, agrees: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the midpoint of the two rays' closest approach, NaN unless in front of both and not almost parallel."""
    depth_i, depth_j = _depths_along(pose, rays_i, rays_j)
    to_first = pose[:3, :3].T
    midpoint = 0.5 * (depth_i[:, None] * rays_i + (depth_j[:, None] * rays_j - pose[:3, 3]) @ to_first.T)
    # Beyond 200 baselines the angle of the rays is below 0.3 degrees: the distance is noise.
    good = agrees & (depth_i > 0) & (depth_j > 0) & (depth_i < 200.0)
    return np.where(good[:, None], midpoint, np.nan), good


def median_parallax(points: np.ndarray, pose: np.ndarray) -> float:
    """Return the median angle between the rays to points [n, 3] from two cameras, radians.

    Points are in the first camera; the pose of the second is first -> second.
    """
    second = points - (-pose[:3, :3].T @ pose[:3, 3])
    cosine = (points * second).sum(axis=1) / (np.linalg.norm(points, axis=1) * np.linalg.norm(second, axis=1))
    return float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _rotation_between(rays_i: np.ndarray, rays_j: np.ndarray) -> np.ndarray:
    """Return the rotation from unit vectors i to j: Kabsch (1976), reweighted for least absolute error."""
    rotation, _ = Rotation.align_vectors(rays_j, rays_i)
    for _ in range(5):
        off = np.linalg.norm(rotation.apply(rays_i) - rays_j, axis=1)
        rotation, _ = Rotation.align_vectors(rays_j, rays_i, 1.0 / np.maximum(off, 1e-4))
    return np.asarray(rotation.as_matrix())


def _failed(count: int, result: GeometryResult) -> StartGuess:
    return StartGuess(np.eye(4), np.full((count, 3), np.nan), np.zeros(count, dtype=bool), 0.0, result)
