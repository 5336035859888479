"""A model that places a whole window, used to place one frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from vggtgeo.models.roles import GeometryResult, InitialGeometry, PoseGuess, PoseQuery, StartGuess, WindowGeometry
from vggtgeo.models.window_alignment import align_window


@dataclass(frozen=True)
class WindowLocator:
    """An `InitialGeometry` from a `WindowGeometry` (VGGT, say) and a `judge` (PnP, say).

    The model places the query's keyframes and its frame together; the window is then aligned to the keyframes' known
    poses, and the frame's pose in it becomes the prediction that the judge accepts, improves or replaces by its own.
    Where the window does not determine it, the judge works with the query's prediction.

    views: most views the model takes, the frame included, None for any number; the query's first keyframes are taken.
    """

    model: WindowGeometry
    judge: InitialGeometry
    views: int | None = None

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

    def start(self, pixels_i: np.ndarray, pixels_j: np.ndarray, intrinsics: np.ndarray) -> StartGuess:
        """Motion and structure of the first two views, by the judge; see `InitialGeometry.start`."""
        return self.judge.start(pixels_i, pixels_j, intrinsics)

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
