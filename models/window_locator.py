"""Localisation of one frame by a model that estimates a whole window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from vggtgeo.models.classical.two_view import median_parallax
from vggtgeo.models.roles import (
    GeometryResult,
    InitialGeometry,
    PoseGuess,
    PoseQuery,
    StartGuess,
    WindowGeometry,
    WindowGuess,
)

from vggtgeo.geometry import pinhole, rigid


@dataclass(frozen=True)
class WindowLocator:
    """An `InitialGeometry` from a `WindowGeometry` (VGGT, for example) and a `judge` (PnP).

    The model estimates the query's keyframes and frame together. The window is aligned with the known poses of the
    keyframes, and the pose of the frame in it is the prediction that the judge accepts, refines or replaces. If the
    window does not determine it, the judge uses the query's prediction.

    The first two views start from the model's depth and motion if matches confirm them, else by the judge alone.
    Predicted depth needs less parallax than triangulation, but some: the baseline determines the map's scale.

    least: minimum number of matches, and parallax: minimum median angle between their rays, radians, of such a start.
    views: maximum number of views of the model, the frame included, None for any; the first keyframes are used.
    """

    model: WindowGeometry
    judge: InitialGeometry
    views: int | None = None
    least: int = 60
    parallax: float = float(np.deg2rad(1.0))

    def locate(self, query: PoseQuery) -> PoseGuess:
        predicted = self._predict(query)
        if predicted is None:
            return self.judge.locate(query)
        judged = self.judge.locate(replace(query, predicted=predicted))
        if len(query.points):
            return judged
        # Without matches the judge has no evidence: the model's pose is used.
        return PoseGuess(predicted, judged.inliers, judged.error, GeometryResult.SUCCESS)

    def start(
        self,
        pixels_i: np.ndarray,
        pixels_j: np.ndarray,
        intrinsics: np.ndarray,
        images: Sequence[np.ndarray] = (),
    ) -> StartGuess:
        guess = self._start(pixels_i, pixels_j, np.asarray(intrinsics), images) if len(images) else None
        return self.judge.start(pixels_i, pixels_j, intrinsics, images) if guess is None else guess

    def _start(
        self, pixels_i: np.ndarray, pixels_j: np.ndarray, intrinsics: np.ndarray, images: Sequence[np.ndarray]
    ) -> StartGuess | None:
        """Return the model's start if the judge finds enough matches and parallax, else None."""
        guess = self.model.window(images, intrinsics)
        if not guess.found.all():
            return None
        known, points = _unproject(pixels_i, guess.depth[0], intrinsics)
        judged = self.judge.locate(
            PoseQuery(
                image=images[1],
                intrinsics=intrinsics,
                points=points[known],
                pixels=pixels_j[known],
                confidence=np.ones(np.count_nonzero(known)),
                predicted=guess.poses[1] @ rigid.invert(guess.poses[0]),
            )
        )
        if judged.result is not GeometryResult.SUCCESS or judged.inlier_count < self.least:
            return None
        inliers = np.zeros(len(points), bool)
        inliers[np.flatnonzero(known)[judged.inliers]] = True
        parallax = median_parallax(points[inliers], judged.pose)
        if parallax < self.parallax:
            return None
        baseline = np.linalg.norm(judged.pose[:3, 3])
        pose = judged.pose.copy()
        pose[:3, 3] /= baseline
        return StartGuess(pose, points / baseline, inliers, parallax, GeometryResult.SUCCESS)

    def _predict(self, query: PoseQuery) -> np.ndarray | None:
        if not query.window_images:
            return None
        most = None if self.views is None else self.views - 1
        images, poses, depths = query.window_images[:most], query.window_poses[:most], query.window_depths[:most]
        guess = self.model.window([*images, query.image], np.asarray(query.intrinsics))
        if not guess.found[-1]:
            return None
        aligned = align_window(guess, np.stack(poses), depths)
        return None if aligned is None else aligned.poses[-1]


def _unproject(pixels: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels [n, 2] have depth, bool [n], and their points in the camera's frame [n, 3], NaN = none."""
    z = pinhole.at_pixels(depth, pixels).astype(np.float64)
    known = z > 0
    return known, pinhole.rays(np.asarray(pixels, np.float64), intrinsics) * np.where(known, z, np.nan)[:, None]


_ENOUGH_PIXELS = 5000
"""Pixels of a view that determine its scale."""


def align_window(guess: WindowGuess, poses: np.ndarray, depths: Sequence[np.ndarray] = ()) -> WindowGuess | None:
    """Return the window in the world in which `poses` are, with metric translations and depths; None if that is
    undetermined.

    The scale s is the confidence-weighted median of `depths` / window depth where both are known; otherwise,
    unless the window is metric, the ratio of the spreads of the camera centres. Then X_window = R X_world + t is the
    rotation closest to all G_k^-1 P_k (chordal mean) and the translation that makes the mean centres coincide.

    poses: float [k, 4, 4], world -> camera, of the first k views of the window. depths: of those views, float [H, W]
    in metres, NaN = none.
    """
    use = np.flatnonzero(guess.found[: len(poses)])
    scale = _scale(guess, poses, depths, use)
    if not len(use) or scale is None:
        return None
    placed = guess.poses.copy()
    placed[:, :3, 3] *= scale
    between = np.swapaxes(placed[use, :3, :3], 1, 2) @ poses[use, :3, :3]
    rotation = Rotation.from_matrix(between).mean().as_matrix()
    to_window = np.eye(4)
    to_window[:3, :3] = rotation
    to_window[:3, 3] = (rigid.centres(placed[use]) - rigid.centres(poses[use]) @ rotation.T).mean(axis=0)
    depth = (guess.depth * np.float32(scale)).astype(np.float32)
    return replace(guess, poses=placed @ to_window, depth=depth, metric=True)


def _scale(guess: WindowGuess, poses: np.ndarray, depths: Sequence[np.ndarray], use: np.ndarray) -> float | None:
    by_depth = _depth_scale(guess, depths, use)
    if by_depth is not None:
        return by_depth
    if guess.metric:
        return 1.0
    if len(use) < 2:
        return None
    own, known = (
        float(np.linalg.norm(centres - centres.mean(axis=0)))
        for centres in (rigid.centres(guess.poses[use]), rigid.centres(poses[use]))
    )
    # Below 1 cm of motion the scale would be noise of the poses.
    return known / own if known > 0.01 and own > 1e-9 else None


def _depth_scale(guess: WindowGuess, depths: Sequence[np.ndarray], use: np.ndarray) -> float | None:
    ratios, weights = [], []
    for view in use[use < len(depths)]:
        # The median of some thousand pixels is accurate enough.
        step = max(1, int(np.sqrt(depths[view].size / _ENOUGH_PIXELS)))
        own, known, confidence = (
            image[::step, ::step] for image in (guess.depth[view], depths[view], guess.confidence[view])
        )
        both = (own > 0) & (known > 0)
        ratios.append(known[both] / own[both])
        weights.append(confidence[both])
    if not ratios:
        return None
    ratio, weight = np.concatenate(ratios), np.concatenate(weights)
    return _weighted_median(ratio, weight) if weight.sum() > 0 else None


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
