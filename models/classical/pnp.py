"""Pose of a new frame from known points (PnP), supported by a predicted pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from vggtgeo.models.classical.two_view import TwoViewStart
from vggtgeo.models.classical.verification import SampleOrder
from vggtgeo.models.roles import GeometryResult, PoseGuess, PoseQuery, StartGuess

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.gauss_newton import damped_step, gauss_newton
from vggtgeo.geometry.rigid import exponential
from vggtgeo.io.argument_checks import check_fields


@dataclass(frozen=True)
class _TwoViewGeometry:
    """Base of the `InitialGeometry`s that begin with the matches of two views."""

    two_view: TwoViewStart = field(default_factory=TwoViewStart, kw_only=True)

    def start(
        self,
        pixels_i: np.ndarray,
        pixels_j: np.ndarray,
        intrinsics: np.ndarray,
        images: Sequence[np.ndarray] = (),
    ) -> StartGuess:
        return self.two_view.start(pixels_i, pixels_j, intrinsics)


@dataclass(frozen=True)
class PnpGeometry(_TwoViewGeometry):
    """P3P inside MAGSAC++ (Barath et al. 2020), then a robust refinement weighted by confidence.

    The predicted pose competes with the sampled one: the pose with more inliers is the start of the refinement, so that
    a frame with too few matches for sampling is still tracked. If the refined prediction explains the share `sure` of
    the matches, no other pose could explain as many, and none is sampled.

    threshold: maximum reprojection error of an inlier, pixels. least: minimum number of inliers of a success.
    """

    threshold: float = 6.0
    least: int = 12
    confidence: float = 0.999
    max_iterations: int = 1000
    sure: float = 0.9
    order: SampleOrder = field(default_factory=SampleOrder)

    def __post_init__(self) -> None:
        check_fields(self, threshold="(0, inf)", least="[6, inf)")

    def locate(self, query: PoseQuery) -> PoseGuess:
        if len(query.points) < self.least:
            return failed_guess(query, GeometryResult.TOO_FEW_MATCHES)
        intrinsics = np.asarray(query.intrinsics, dtype=np.float64)
        pose = self._start(query, intrinsics)
        if pose is None:
            return failed_guess(query, GeometryResult.DEGENERATE)
        inliers = self._inliers(pose, query)
        for _ in range(2):
            if np.count_nonzero(inliers) < self.least:
                return failed_guess(query, GeometryResult.TOO_FEW_INLIERS)
            weights = query.confidence[inliers] + 1e-3
            pose = refine_pose(pose, query.points[inliers], query.pixels[inliers], weights, intrinsics)
            inliers = self._inliers(pose, query)
        error = _errors(pose, query)[inliers]
        if len(error) < self.least:
            return failed_guess(query, GeometryResult.TOO_FEW_INLIERS)
        return PoseGuess(pose, inliers, float(np.median(error)), GeometryResult.SUCCESS)

    def _start(self, query: PoseQuery, intrinsics: np.ndarray) -> np.ndarray | None:
        """Return the refined prediction if most matches agree with it, else the better of it and a sampled pose."""
        if query.predicted is not None:
            refined = refine_pose(query.predicted, query.points, query.pixels, query.confidence + 1e-3, intrinsics)
            if np.count_nonzero(self._inliers(refined, query)) >= max(self.sure * len(query.points), 3 * self.least):
                return refined
        starts = [pose for pose in (query.predicted, self._sample(query)) if pose is not None]
        support = lambda start: float(query.confidence[self._inliers(start, query)].sum())
        return max(starts, key=support) if starts else None

    def _sample(self, query: PoseQuery) -> np.ndarray | None:
        order = self.order.of(len(query.points))
        try:
            found, rotation, translation, _ = cv2.solvePnPRansac(
                query.points[order].astype(np.float64),
                query.pixels[order].astype(np.float64),
                pinhole.matrix(query.intrinsics),
                None,
                flags=cv2.USAC_MAGSAC,
                reprojectionError=self.threshold,
                confidence=self.confidence,
                iterationsCount=self.max_iterations,
            )
        except cv2.error:
            return None
        if not found or not np.isfinite(rotation).all() or not np.isfinite(translation).all():
            return None
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(rotation)[0]
        pose[:3, 3] = translation.ravel()
        return pose

    def _inliers(self, pose: np.ndarray, query: PoseQuery) -> np.ndarray:
        return _errors(pose, query) < self.threshold


@dataclass(frozen=True)
class ConstantVelocity(_TwoViewGeometry):
    """Use the predicted pose unchanged, for bundle adjustment to correct; matches are only counted.

    threshold: maximum reprojection error of an inlier, pixels; large, since a prediction is coarse.
    """

    threshold: float = 30.0

    def locate(self, query: PoseQuery) -> PoseGuess:
        if query.predicted is None:
            return failed_guess(query, GeometryResult.NO_PREDICTION)
        errors = _errors(query.predicted, query)
        inliers = errors < self.threshold
        error = float(np.median(errors[inliers])) if inliers.any() else float("nan")
        return PoseGuess(query.predicted, inliers, error, GeometryResult.SUCCESS)


def failed_guess(query: PoseQuery, result: GeometryResult) -> PoseGuess:
    """Return a failure with its reason, at the predicted pose, or the identity without a prediction."""
    pose = np.eye(4) if query.predicted is None else query.predicted
    return PoseGuess(pose, np.zeros(len(query.points), dtype=bool), float("nan"), result)


def _errors(pose: np.ndarray, query: PoseQuery) -> np.ndarray:
    return np.linalg.norm(residuals(pose, query.points, query.pixels, np.asarray(query.intrinsics))[0], axis=1)


def refine_pose(
    pose: np.ndarray,
    points: np.ndarray,
    pixels: np.ndarray,
    weights: np.ndarray,
    intrinsics: np.ndarray,
    delta: float = 1.5,
    steps: int = 10,
) -> np.ndarray:
    """Return the pose T that minimises sum_n w_n rho(|pi(T X_n) - u_n|), with Huber's rho of `delta` pixels.

    The Jacobian is d pi / d xi for the left perturbation T <- exp(xi) T. Cost: O(n) a step.

    pose: [4, 4] world -> camera, the start. points [n, 3], pixels [n, 2], weights [n]. Returns float64 [4, 4].
    """

    def evaluate(pose: np.ndarray) -> tuple[float, Callable[[], np.ndarray]]:
        error, local = residuals(pose, points, pixels, intrinsics)
        # A point behind the camera costs as much as one a thousand pixels away, so that the energy stays finite.
        size = np.minimum(np.hypot(error[:, 0], error[:, 1]), 1e3)
        energy = weights @ np.where(size <= delta, size * size, delta * (2.0 * size - delta))
        return float(energy), lambda: _step(error, local, weights, intrinsics, delta)

    return gauss_newton(pose, evaluate, lambda pose, step: exponential(step) @ pose, steps=steps)


def residuals(
    pose: np.ndarray, points: np.ndarray, pixels: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return reprojection errors [n, 2], pixels, inf behind the camera, and points [n, 3] in the camera's frame."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    error = pinhole.project(local, intrinsics) - pixels
    return np.where(np.isnan(error), np.inf, error), local


def pose_information(pose: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, sigma: float) -> np.ndarray:
    """Return the information of matches about a pose, `sum J^T J / sigma^2`, by its left tangent, [6, 6].

    pose: [4, 4] world -> camera. points: [n, 3], the inliers. sigma: standard deviation of a match, pixels.
    """
    local = points @ pose[:3, :3].T + pose[:3, 3]
    row_x, row_y = pinhole.projection_rows(local[local[:, 2] > 1e-3], intrinsics)
    return (row_x @ row_x.T + row_y @ row_y.T) / sigma**2


def _step(
    error: np.ndarray, local: np.ndarray, weights: np.ndarray, intrinsics: np.ndarray, delta: float
) -> np.ndarray:
    use = np.isfinite(error[:, 0])
    if not use.all():
        error, local, weights = error[use], local[use], weights[use]
    weights = weights * np.minimum(1.0, delta / np.maximum(np.hypot(error[:, 0], error[:, 1]), 1e-12))
    row_x, row_y = pinhole.projection_rows(local, intrinsics)
    hessian = (row_x * weights) @ row_x.T + (row_y * weights) @ row_y.T
    return damped_step(hessian, row_x @ (weights * error[:, 0]) + row_y @ (weights * error[:, 1]))
