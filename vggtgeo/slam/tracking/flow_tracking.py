"""Pose of a frame from key points that optical flow follows from a keyframe, without descriptors.

Between two keyframes the image changes little, and the motion prior predicts each point. Flow is fast, but fails with
sudden motion, changes of exposure and occlusion. The result is therefore used only if enough points are followed
(`MIN_FOLLOWED`), they agree on one pose (`MIN_INLIER_SHARE`), and they are more than the number below which a frame
becomes a keyframe (`MIN_INLIERS`). Otherwise the frame is described and matched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models.classical import PatchFlow
from vggtgeo.models.roles import GeometryResult, InitialGeometry, PointMatches, PoseGuess, PoseQuery
from vggtgeo.slam.settings.groups import MIN_CONFIDENCE
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.tracking.tracking_state import SeenPoints

MAX_POINTS = 300
"""Largest number of key points of a keyframe that are used, spread over its image: more cost time, share the keyframe's
error and do not improve a pose."""
TRUSTED = 0.5
"""Confidence of a key point's depth: points below it are used only if there are no others."""
MIN_FOLLOWED = 0.4
"""Minimum share of the points in view that optical flow must follow; from a bad guess it still follows 0.4 or more."""
MIN_INLIER_SHARE = 0.7
"""Minimum inlier share of the followed points; wrong poses have at most 0.5, see `pose_acceptance.py`."""
MIN_INLIERS = 60
"""Above it a frame does not become a keyframe for want of matches (`KeyframeSettings.min_inliers`)."""
MAX_KEPT = 128
"""Largest number of matches that a frame keeps for the final resection, 1.5 kB: with a pixel of noise they place it to
a tenth of one."""
FLOW_SIGMA = 4.0
"""Standard deviation of a match, pixels: a tenth of it is the flow's own, the rest comes from depth errors of the
keyframe, which are the same in all following frames."""


@dataclass(frozen=True, eq=False)
class Located:
    """A pose from key points, the number of matches, and their world points, float64 [m, 3].

    sigma: standard deviation of a match, pixels. slots: int [m], slots of these matches in the keyframe, and pixels:
    float64 [m, 2], in the frame; None for matches with several keyframes. with_unknown_depth: the matches with those of
    unknown depth; None by flow, or with several keyframes.
    """

    guess: PoseGuess
    matches: int
    points: np.ndarray
    sigma: float
    slots: np.ndarray | None = None
    pixels: np.ndarray | None = None
    with_unknown_depth: PointMatches | None = None

    @property
    def seen(self) -> SeenPoints | None:
        """Some of the inliers, in even steps."""
        if self.slots is None or self.pixels is None:
            return None
        agree = np.flatnonzero(self.guess.inliers)
        some = agree[np.unique(np.linspace(0, len(agree) - 1, min(MAX_KEPT, len(agree))).astype(int))]
        return SeenPoints(self.slots[some].astype(np.int32), self.pixels[some].astype(np.float32))


def located_by_flow(
    image: np.ndarray,
    keyframe: Keyframe,
    predicted: np.ndarray,
    intrinsics: np.ndarray,
    flow: PatchFlow,
    geometry: InitialGeometry,
) -> Located | None:
    """Return the pose of `image`, uint8 [H, W, 3], near `predicted`, float64 [4, 4], world -> camera; None if
    uncertain.
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
    seen = seen[np.argsort(doubtful, kind="stable")][:MAX_POINTS]
    if len(seen) < MIN_INLIERS:
        return None
    asked, points = known[seen], points[seen]
    pixels = keyframe.points.pixels[asked]
    moved, alike = flow.follow(keyframe.image, image, pixels, expected[seen])
    arrived = np.flatnonzero(np.isfinite(alike))
    if len(arrived) < max(MIN_FOLLOWED * len(seen), MIN_INLIERS):
        return None
    # Followed points are not key points of the frame.
    nowhere = np.full(len(arrived), -1)
    # A point is as good as the worse known of its two ends: the match in the image, and the depth in the keyframe.
    trust = np.clip(alike[arrived], 0.0, 1.0) * np.maximum(
        keyframe.points.prior_confidence[asked[arrived]], MIN_CONFIDENCE
    )
    matches = PointMatches(asked[arrived], nowhere, pixels[arrived], moved[arrived], trust)
    points = points[arrived]
    guess = geometry.locate(PoseQuery(image, intrinsics, points, matches.pixels_j, matches.confidence, predicted))
    agree = guess.inlier_count >= max(MIN_INLIER_SHARE * len(arrived), MIN_INLIERS)
    if guess.result is not GeometryResult.SUCCESS or not agree:
        return None
    return Located(guess, len(matches), points, FLOW_SIGMA, matches.index_i, matches.pixels_j)
