"""Evidence for a tracked pose, and the decision whether to accept it.

A number of inliers alone is weak evidence: with repeated structure half of the matches may agree on a wrong pose. A
pose therefore needs two of four kinds of evidence, or one that is strong:

- points: number of inliers, and their share of the matches;
- lines: share of the visible segments that are matched;
- image and surface: brightness and depth of the keyframe, warped by the pose, against those of the frame;
- motion: whether a step of this size is plausible after the motion so far.

The levels separate 230 pairs of frames at right poses (correlation above 0.44 at the 5th percentile) from 138 pairs of
distant places and mirrored frames (correlation below 0.10; never both 30 inliers and half of the matches).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import POSE_GATE, inverse_information

NAN = float("nan")
MIN_INLIERS, STRONG_INLIERS = 12, 30
"""Number of points that are inliers."""
MIN_SHARE, STRONG_SHARE, PLACE_SHARE = 0.4, 0.5, 0.6
"""Share of the matches, of points or of lines, that are inliers: beside evidence of another kind, alone, and at a place
that was found by its appearance."""
MIN_LINES, STRONG_LINES = 8, 12
"""Number of segments that are matched in agreement with the pose."""
MIN_CORRELATION, STRONG_CORRELATION, CONTRADICTION = 0.4, 0.6, 0.1
"""Correlation of the brightness at edges: beside other evidence, alone, and that of wrong poses, below which the image
contradicts the pose, whatever else agrees."""
MIN_SURFACE, MIN_OVERLAP = 0.85, 0.2
"""Share of the surface that agrees, and overlap, beside a correlation: 15 % may be hidden, moved or noise, and the rest
must be seen on a fifth of the image."""
BARE_SURFACE, BARE_OVERLAP, BARE_SIGMA = 0.95, 0.5, 0.03
"""Evidence of surfaces alone, for images without texture: share that agrees, overlap, and largest standard deviation in
the worst direction, metres. Stricter, since a plane agrees with any motion along it."""
MIN_CORRELATION_RATIO = 0.8
"""Correlation that an old keyframe must have to become the reference again, relative to that of the current one: a
fifth less may be due to the view alone. A keyframe taken in a fast turn is sheared by the rolling shutter: frames
tracked against it are off by centimetres although they have many inliers."""
STEP_FLOOR, STEP_GROWTH = (0.10, np.deg2rad(6.0)), 0.7
"""Standard deviation of a prediction by constant velocity: metres, radians, and the share of the last step that is
added to each. 99 % of the steps of a fast head-mounted camera are within three of these."""
MAX_SIGMA = STEP_FLOOR[0]
"""Largest standard deviation of an accepted pose in its worst direction, metres: a measurement that is less certain
than the prediction says nothing."""
SYSTEMATIC = (0.002, np.deg2rad(0.05), 0.01)
"""Standard deviation of errors that samples share (calibration, rolling shutter, clocks): metres, radians, share of the
motion. Set so that the squared Mahalanobis distance of dense alignments from the ground truth has the median of
chi-square with 6 degrees of freedom, 5.3 (`benchmarks/alignment.py`)."""


@dataclass(frozen=True)
class TrackingQuality:
    """Measures of the quality of one frame's pose. NaN = not measured.

    matches, inliers: of key points with known depth. correlation: in [-1, 1], of the brightness at edges, keyframe
    against frame. surface: share in [0, 1] of surface points that agree. overlap: share of the keyframe's surface that
    the frame sees. sigma_translation, sigma_rotation: standard deviation of the pose relative to the keyframe in its
    worst direction, metres and radians, from the information matrix. chi2: squared Mahalanobis distance from the
    predicted pose, 6 degrees of freedom. lines, visible_lines: segments of the keyframe that are matched in agreement
    with the pose, and those expected in the image. map_points: number of matched key points of other keyframes. metre:
    length that stands for a metre in a map of free scale, in its unit, see `metre_of`. by_two_view: whether the pose is
    from key points without known depth, so that its baseline is weakly constrained, see `two_view_motion.py`. recorded:
    whether it is a recorded pose that no image has measured.
    """

    matches: int = 0
    inliers: int = 0
    correlation: float = NAN
    surface: float = NAN
    overlap: float = NAN
    sigma_translation: float = NAN
    sigma_rotation: float = NAN
    chi2: float = NAN
    lines: int = 0
    visible_lines: int = 0
    map_points: int = 0
    metre: float = 1.0
    by_two_view: bool = False
    recorded: bool = False

    @property
    def share(self) -> float:
        """Share of the matches that are inliers, in [0, 1]."""
        return self.inliers / max(self.matches, 1)

    @property
    def plausible(self) -> bool:
        """Whether the step is plausible after the motion so far; true without a prediction."""
        # NaN (no prediction) compares false, so the step is plausible then.
        return not self.chi2 > POSE_GATE

    @property
    def points_fair(self) -> bool:
        return self.inliers >= MIN_INLIERS and self.share >= MIN_SHARE

    @property
    def points_strong(self) -> bool:
        return self.inliers >= STRONG_INLIERS and self.share >= STRONG_SHARE

    def shows_as_well(self, other: TrackingQuality) -> bool:
        """Return whether the correlation with this keyframe is about as good as the other's; true without one."""
        return not self.correlation < MIN_CORRELATION_RATIO * other.correlation

    @property
    def line_share(self) -> float:
        """Share of the expected segments that are matched, in [0, 1]."""
        return self.lines / max(self.visible_lines, 1)

    @property
    def lines_fair(self) -> bool:
        return self.lines >= MIN_LINES and self.line_share >= MIN_SHARE

    @property
    def lines_strong(self) -> bool:
        """Whether lines alone suffice; `accepted` also requires that all directions are constrained."""
        return self.lines >= STRONG_LINES and self.line_share >= STRONG_SHARE

    @property
    def dense_fair(self) -> bool:
        """Whether image and surface agree with the pose; a comparison with NaN is false."""
        surface = not self.surface < MIN_SURFACE
        return self.correlation >= MIN_CORRELATION and self.overlap >= MIN_OVERLAP and surface

    @property
    def dense_strong(self) -> bool:
        """Whether image, or image and surface together, suffice alone."""
        surfaces = self.surface >= BARE_SURFACE and self.overlap >= BARE_OVERLAP
        return self.dense_fair and (self.correlation >= STRONG_CORRELATION or surfaces)

    @property
    def bare_surface(self) -> bool:
        """Whether surfaces alone constrain the pose in an image without texture."""
        seen = self.surface >= BARE_SURFACE and self.overlap >= BARE_OVERLAP
        return bool(np.isnan(self.correlation)) and seen and self.sigma_translation < BARE_SIGMA

    @property
    def accepted(self) -> bool:
        """Whether the pose is accepted."""
        if self.by_two_view or self.recorded:
            # Without depth there is neither a surface nor a picture to compare: only the points can confirm the pose.
            return self.recorded or self.points_strong
        if self.sigma_translation > MAX_SIGMA * self.metre or self.correlation < CONTRADICTION:
            return False
        if not self.plausible:
            # A step against the prediction may be a jerk or a wrong pose, so two independent kinds of evidence must
            # confirm it.
            return self.points_strong and self.dense_fair
        # A NaN correlation (nothing to compare) does not contradict.
        fair = self.points_fair and not self.correlation < MIN_CORRELATION
        by_lines = self.lines_strong or (self.lines_fair and self.dense_fair)
        return self.points_strong or fair or self.dense_strong or self.bare_surface or by_lines

    @property
    def certain(self) -> bool:
        """Whether the pose is accepted without a prediction, among all places of the map (relocalization)."""
        known_place = self.inliers >= STRONG_INLIERS and self.share >= PLACE_SHARE
        measured = self.sigma_translation <= MAX_SIGMA * self.metre
        return measured and known_place and not self.correlation < MIN_CORRELATION


def step_chi2(pose: np.ndarray, predicted: np.ndarray, step: np.ndarray, waited: int = 0) -> float:
    """Return the squared Mahalanobis distance of `pose` from a prediction by constant velocity, 6 degrees of freedom.

    pose, predicted: float64 [4, 4], world -> camera. step: the last motion, camera -> camera. waited: frames since the
    prediction was last confirmed; each adds a step's variance.
    """
    # Translation and rotation are compared by their lengths: the direction of a jerk is as unknown as its size.
    off = tangent(pose @ rigid.invert(predicted))
    return float(off @ step_information(step) @ off) / (waited + 1)


def step_information(step: np.ndarray) -> np.ndarray:
    """Return the information float64 [6, 6] of a prediction by constant velocity, equal in all directions."""
    last = tangent(step)
    sigma = [floor + STEP_GROWTH * np.linalg.norm(last[i : i + 3]) for floor, i in zip(STEP_FLOOR, (0, 3), strict=True)]
    return np.diag(1.0 / np.repeat(sigma, 3) ** 2)


def tangent(motion: np.ndarray) -> np.ndarray:
    """Return translation and rotation vector of a rigid motion, float64 [6]: to first order its logarithm."""
    # OpenCV's conversion takes a tenth of the time of SciPy's, and this is called a hundred times a frame.
    return np.concatenate([motion[:3, 3], cv2.Rodrigues(motion[:3, :3])[0].ravel()])


def worst_sigma(information: np.ndarray) -> tuple[float, float]:
    """Return the standard deviations of translation and of rotation in their worst directions. information: float64 [6,
    6].
    """
    covariance = inverse_information(information)
    return tuple(float(np.sqrt(np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1])) for i in (0, 3))  # type: ignore[return-value]
