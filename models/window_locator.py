"""A model that places a whole window, used to place one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from vggtgeo.models.classical.two_view import median_parallax
from vggtgeo.models.roles import GeometryResult, InitialGeometry, PoseGuess, PoseQuery, StartGuess, WindowGeometry
from vggtgeo.models.window_alignment import align_window

from vggtgeo.geometry import pinhole, rigid


@dataclass(frozen=True)
class WindowLocator:
    """An `InitialGeometry` from a `WindowGeometry` (VGGT, say) and a `judge` (PnP, say).

    The model places the query's keyframes and its frame together; the window is then aligned to the keyframes' known
    poses, and the frame's pose in it becomes the prediction that the judge accepts, improves or replaces by its own.
    Where the window does not determine it, the judge works with the query's prediction.

    The first two views start from the model's depth and motion, if matches bear them out; else by the judge alone.
    Depth that is not triangulated needs less parallax, but some: the baseline is what holds the map's scale.

    least: fewest matches, and parallax: least median angle between their rays, radians, of such a start.
    views: most views the model takes, the frame included, None for any number; the query's first keyframes are taken.
    """

    model: WindowGeometry
    judge: InitialGeometry
    views: int | None = None
    least: int = 60
    parallax: float = float(np.deg2rad(1.0))

    def __post_init__(self) -> None:
        if self.views is not None and self.views < 2:
            raise ValueError(f"`views` is {self.views}, expected at least 2: a keyframe and the frame")

    def locate(self, query: PoseQuery) -> PoseGuess:
        """The pose of the query's frame; see `InitialGeometry.locate`."""
        predicted = self._predict(query)
        if predicted is None:
            return self.judge.locate(query)
        judged = self.judge.locate(replace(query, predicted=predicted))
        if len(query.points):
            return judged
        # Without a match there is nothing to judge by: the model's word is all there is.
        return PoseGuess(predicted, judged.inliers, judged.error, GeometryResult.SUCCESS)

    def start(
        self,
        pixels_i: np.ndarray,
        pixels_j: np.ndarray,
        intrinsics: np.ndarray,
        images: Sequence[np.ndarray] = (),
    ) -> StartGuess:
        """Motion and structure of the first two views; see `InitialGeometry.start`."""
        guess = self._start(pixels_i, pixels_j, np.asarray(intrinsics), images) if len(images) else None
        return self.judge.start(pixels_i, pixels_j, intrinsics, images) if guess is None else guess

    def _start(
        self, pixels_i: np.ndarray, pixels_j: np.ndarray, intrinsics: np.ndarray, images: Sequence[np.ndarray]
    ) -> StartGuess | None:
        """The model's start, where the judge finds matches and parallax enough; else None."""
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
    """Which pixels [n, 2] have a depth, bool [n], and their points float64 [n, 3], camera frame, NaN = none."""
    height, width = depth.shape
    columns, rows = np.rint(pixels).astype(int).T
    z = depth[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float64)
    known = z > 0
    return known, pinhole.rays(np.asarray(pixels, np.float64), intrinsics) * np.where(known, z, np.nan)[:, None]
