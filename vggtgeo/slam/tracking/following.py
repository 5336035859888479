"""A frame's pose by key points of a keyframe that are followed into it by their patches, without descriptors.

Between two keyframes the picture changes little, and the motion so far says where each point must be. That is quick,
and it fails where the motion jumps, the picture darkens, or something comes between. So it has to show that it did not:
enough points arrive (`LEAST_ARRIVED`), they agree on one pose (`LEAST_SHARE`), and they are more than the number below
which a frame becomes a keyframe (`LEAST_INLIERS`). Else the frame is described and matched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models.classical import PatchFlow
from vggtgeo.models.roles import GeometryResult, InitialGeometry, PointMatches, PoseGuess, PoseQuery
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.tracking.tracker import SeenPoints

MOST_POINTS = 300
"""Key points that are followed, the best of each part of the image; a pose needs no more."""
TRUSTED, LEAST_TRUST = 0.5, 0.1
"""Confidence of a key point's depth: below the first, points are followed only where there are no others; no point
counts less than the second, so that a map without depth of its own can be tracked, too."""
LEAST_ARRIVED = 0.4
"""Share of those in view. On redkitchen and building-walk, 5 and 1 frames apart, 0.4 to 0.9 arrive from a bad guess."""
LEAST_SHARE = 0.7
"""Of those that arrived, in one pose: far above what wrong poses ever had (0.5, see `evidence.py`)."""
LEAST_INLIERS = 60
MOST_KEPT = 128
"""Matches that a frame keeps for the end, 1.5 kB: with a pixel of noise they place it to a tenth of one."""
FLOW_SIGMA = 4.0
"""Standard deviation of a match, pixels: a tenth of that is the flow's own, the rest the depth of the keyframe at its
points, whose errors are the same in all frames that follow. ATE of icl-office (exact truth): 0.13 cm with 4, 8 and 1000
px, 0.22 with descriptors; with points at jumps of depth among the others, and 2 px, 0.34."""


@dataclass(frozen=True, eq=False)
class Located:
    """A pose by key points, the number of matches that it was sought by, and their points in the world, float64 [m, 3].

    sigma: standard deviation of a match, pixels. slots: int [m] in the points of the keyframe, and pixels: float64
    [m, 2] in the frame, of these matches; none where they are of several keyframes.
    """

    guess: PoseGuess
    matches: int
    points: np.ndarray
    sigma: float
    slots: np.ndarray | None = None
    pixels: np.ndarray | None = None

    @property
    def seen(self) -> SeenPoints | None:
        """Some of the matches that agree with the pose, in even steps."""
        if self.slots is None or self.pixels is None:
            return None
        agree = np.flatnonzero(self.guess.inliers)
        some = agree[np.unique(np.linspace(0, len(agree) - 1, min(MOST_KEPT, len(agree))).astype(int))]
        return SeenPoints(self.slots[some].astype(np.int32), self.pixels[some].astype(np.float32))


def located_by_flow(
    image: np.ndarray,
    keyframe: Keyframe,
    predicted: np.ndarray,
    intrinsics: np.ndarray,
    flow: PatchFlow,
    geometry: InitialGeometry,
) -> Located | None:
    """The pose of the frame with `image` uint8 [H, W, 3] near `predicted` float64 [4, 4], world -> camera; None where
    that is not beyond doubt.
    """
    inverse = keyframe.points.inverse_depth
    known = np.flatnonzero(np.isfinite(inverse))
    points = rigid.unproject(keyframe.points.pixels[known], inverse[known], keyframe.pose, intrinsics)
    with np.errstate(invalid="ignore"):
        expected = rigid.project(points, predicted, intrinsics)
        inside = ((expected >= 0) & (expected < image.shape[1::-1])).all(1)
    seen = np.flatnonzero(inside)
    # Key points stand best first, in turn over the image; those whose depth is at a jump come last.
    doubtful = keyframe.points.prior_confidence[known[seen]] < TRUSTED
    seen = seen[np.argsort(doubtful, kind="stable")][:MOST_POINTS]
    if len(seen) < LEAST_INLIERS:
        return None
    asked, points = known[seen], points[seen]
    pixels = keyframe.points.pixels[asked]
    moved, alike = flow.follow(keyframe.image, image, pixels, expected[seen])
    arrived = np.flatnonzero(np.isfinite(alike))
    if len(arrived) < max(LEAST_ARRIVED * len(seen), LEAST_INLIERS):
        return None
    nowhere = np.full(len(arrived), -1)
    trust = np.clip(alike[arrived], 0.0, 1.0) * np.maximum(
        keyframe.points.prior_confidence[asked[arrived]], LEAST_TRUST
    )
    matches = PointMatches(asked[arrived], nowhere, pixels[arrived], moved[arrived], trust)
    points = points[arrived]
    guess = geometry.locate(PoseQuery(image, intrinsics, points, matches.pixels_j, matches.confidence, predicted))
    agree = guess.inlier_count >= max(LEAST_SHARE * len(arrived), LEAST_INLIERS)
    if guess.result is not GeometryResult.SUCCESS or not agree:
        return None
    return Located(guess, len(matches), points, FLOW_SIGMA, matches.index_i, matches.pixels_j)
