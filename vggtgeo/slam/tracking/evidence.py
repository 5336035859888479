"""What speaks for a tracked pose, and whether it is enough to believe it.

A number of inliers alone is no evidence: with a mirrored picture 28 of 55 matches agreed on a step of 2.7 m. So four
witnesses are heard, and a pose needs two of them, or one that is beyond doubt:

- points: how many matches agree, of how many;
- lines: how many of the segments that the frame should show are there;
- the picture and the surface: do brightness and depth of the keyframe, moved by the pose, look like those of the frame;
- the motion: is the step one that the motion so far allows.

The levels are measured on pairs of frames 1 to 5 apart of two HoloLens clips (230 right poses), on pairs of places that
are far apart and on mirrored frames (138 wrong ones): right poses had a correlation above 0.44 at the 5th percentile,
poses that alignment had carried elsewhere below 0.10; wrong ones never had both 30 inliers and half of the matches.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.stats import chi2 as chi_square

from vggtgeo.geometry import rigid

NAN = float("nan")
LEAST_INLIERS = 12
STRONG_INLIERS = 30
LEAST_SHARE, STRONG_SHARE = 0.4, 0.5
LEAST_LINES, STRONG_LINES = 8, 12
LEAST_LINE_SHARE, STRONG_LINE_SHARE = 0.4, 0.5
LEAST_CORRELATION, STRONG_CORRELATION = 0.4, 0.6
CONTRADICTION = 0.1
LEAST_SURFACE = 0.85
LEAST_OVERLAP = 0.2
BARE_SURFACE, BARE_OVERLAP, BARE_SIGMA = 0.95, 0.5, 0.03
"""Where the picture is empty, surfaces speak alone if so many agree and they determine all directions, metres."""
LARGEST_SIGMA = 0.10
"""Metres; a pose that is measured worse than this in any direction is none."""
STEP_GATE = float(chi_square.ppf(0.9999, 6))
"""Of the squared Mahalanobis distance to the prediction, 6 degrees of freedom."""
AS_WELL = 0.8
"""Of the correlation with the present keyframe that an old one must have to be returned to. One that was taken in a
fast turn is sheared: on TUM freiburg1/rpy frames hung on such a one, with 150 inliers and a correlation of 0.5 in place
of 0.9, stood 4 cm aside."""
STEP_FLOOR, STEP_GROWTH = (0.10, np.deg2rad(6.0)), 0.7
"""Standard deviation of a prediction by constant velocity: metres, radians, and what the last step adds to each, as a
share of it. On the HoloLens clips, the fastest at hand, 99 % of the steps are within 3 of these."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for the pose of one frame. NaN = was not measured.

    matches, inliers: of key points with known depth. error: median reprojection error of the inliers, pixels.
    correlation: in [-1, 1], of the brightness at edges, keyframe against frame. edges, surface: share in [0, 1] of
    brightness samples and of surface points that agree. overlap: share of the keyframe's surface that the frame sees.
    sigma_translation, sigma_rotation: standard deviation of the pose relative to the keyframe in its worst direction,
    metres and radians, from the information matrix. chi2: squared Mahalanobis distance from the predicted pose, 6
    degrees of freedom. agreement: distance between the poses by points and by surface, metres. lines, visible_lines:
    segments of the keyframe whose match in the frame agrees with the pose, and all that the frame should show.
    map_points: key points of other keyframes that were found where the pose says. metre: what stands for a metre in a
    map of free scale, in its unit: `fusion.metre_of`. by_rays: whether the pose is by key points without known depth,
    so that its distance from the keyframe is little more than a guess: `two_view_motion.py`. recorded: whether it is a
    recorded pose, which no image has measured.
    """

    matches: int = 0
    inliers: int = 0
    error: float = NAN
    correlation: float = NAN
    edges: float = NAN
    surface: float = NAN
    overlap: float = NAN
    sigma_translation: float = NAN
    sigma_rotation: float = NAN
    chi2: float = NAN
    agreement: float = NAN
    lines: int = 0
    visible_lines: int = 0
    map_points: int = 0
    metre: float = 1.0
    by_rays: bool = False
    recorded: bool = False

    @property
    def share(self) -> float:
        """Inliers of the matches, in [0, 1]."""
        return self.inliers / max(self.matches, 1)

    @property
    def plausible(self) -> bool:
        """Whether the motion so far allows the step; true where there is no prediction."""
        # NaN (no prediction) compares false, so the step is plausible then.
        return not self.chi2 > STEP_GATE

    @property
    def points_fair(self) -> bool:
        return self.inliers >= LEAST_INLIERS and self.share >= LEAST_SHARE

    @property
    def points_strong(self) -> bool:
        return self.inliers >= STRONG_INLIERS and self.share >= STRONG_SHARE

    def shows_as_well(self, other: Evidence) -> bool:
        """Whether this keyframe shows the frame about as well as the other does; true without pictures to compare."""
        return not self.correlation < AS_WELL * other.correlation

    @property
    def line_share(self) -> float:
        """Segments that agree of those the frame should show, in [0, 1]."""
        return self.lines / max(self.visible_lines, 1)

    @property
    def lines_fair(self) -> bool:
        return self.lines >= LEAST_LINES and self.line_share >= LEAST_LINE_SHARE

    @property
    def lines_strong(self) -> bool:
        """A pose by lines alone also needs all directions to be known: `accepted` asks for that."""
        return self.lines >= STRONG_LINES and self.line_share >= STRONG_LINE_SHARE

    @property
    def dense_fair(self) -> bool:
        """Whether picture and surface agree with the pose; a comparison with NaN is false."""
        surface = not self.surface < LEAST_SURFACE
        return self.correlation >= LEAST_CORRELATION and self.overlap >= LEAST_OVERLAP and surface

    @property
    def dense_strong(self) -> bool:
        """The same beyond doubt: the picture itself, or a fair picture of the same surfaces."""
        surfaces = self.surface >= BARE_SURFACE and self.overlap >= BARE_OVERLAP
        return self.dense_fair and (self.correlation >= STRONG_CORRELATION or surfaces)

    @property
    def placed_by_surface(self) -> bool:
        """Whether picture and surfaces alone place the frame: beyond doubt, and in all directions."""
        return self.dense_strong and self.sigma_translation < BARE_SIGMA

    @property
    def bare_surface(self) -> bool:
        """Whether, in a picture without edges, the surfaces alone determine the pose."""
        seen = self.surface >= BARE_SURFACE and self.overlap >= BARE_OVERLAP
        return bool(np.isnan(self.correlation)) and seen and self.sigma_translation < BARE_SIGMA

    @property
    def accepted(self) -> bool:
        """Whether the pose is to be believed."""
        if self.by_rays or self.recorded:
            # Without depth there is neither a surface nor a picture to compare: only the points can confirm the pose.
            return self.recorded or self.points_strong
        if self.sigma_translation > LARGEST_SIGMA * self.metre or self.correlation < CONTRADICTION:
            return False
        if not self.plausible:
            # A step against the prediction may be a jerk or a wrong pose, so two independent kinds of evidence must
            # confirm it.
            return self.points_strong and self.dense_fair
        # A NaN correlation (nothing to compare) does not contradict.
        fair = self.points_fair and not self.correlation < LEAST_CORRELATION
        by_lines = self.lines_strong or (self.lines_fair and self.dense_fair)
        return self.points_strong or fair or self.dense_strong or self.bare_surface or by_lines

    @property
    def certain(self) -> bool:
        """Whether the pose is to be believed without any prediction, among all places of the map."""
        known_place = self.inliers >= STRONG_INLIERS and self.share >= 0.6
        measured = self.sigma_translation <= LARGEST_SIGMA * self.metre
        return measured and known_place and not self.correlation < LEAST_CORRELATION


def step_chi2(pose: np.ndarray, predicted: np.ndarray, step: np.ndarray, waited: int = 0) -> float:
    """Squared Mahalanobis distance of `pose` from a prediction by constant velocity, 6 degrees of freedom.

    pose, predicted: float64 [4, 4], world -> camera. step: the last motion, camera -> camera. waited: frames since the
    prediction was last confirmed; each adds a step's variance.
    """
    # Translation and rotation are compared by their lengths: the direction of a jerk is as unknown as its size.
    off = tangent(pose @ rigid.invert(predicted))
    last = tangent(step)
    sigma = [floor + STEP_GROWTH * np.linalg.norm(last[i : i + 3]) for floor, i in zip(STEP_FLOOR, (0, 3), strict=True)]
    return float(sum((np.linalg.norm(off[i : i + 3]) / s) ** 2 for s, i in zip(sigma, (0, 3), strict=True))) / (
        waited + 1
    )


def step_information(step: np.ndarray) -> np.ndarray:
    """Information float64 [6, 6] of a prediction by constant velocity."""
    last = tangent(step)
    sigma = [floor + STEP_GROWTH * np.linalg.norm(last[i : i + 3]) for floor, i in zip(STEP_FLOOR, (0, 3), strict=True)]
    return np.diag(1.0 / np.repeat(sigma, 3) ** 2)


def tangent(motion: np.ndarray) -> np.ndarray:
    """Translation and rotation vector of a rigid motion, float64 [6]: to first order its logarithm."""
    # OpenCV's conversion takes a tenth of the time of SciPy's, and this is called a hundred times a frame.
    return np.concatenate([motion[:3, 3], cv2.Rodrigues(motion[:3, :3])[0].ravel()])


def worst_sigma(information: np.ndarray) -> tuple[float, float]:
    """Standard deviation in the worst direction of translation and of rotation, of information float64 [6, 6]."""
    # The regulariser turns a direction without information into a very large, but finite, standard deviation.
    covariance = np.linalg.inv(information + 1e-9 * np.eye(6))
    return tuple(float(np.sqrt(np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1])) for i in (0, 3))  # type: ignore[return-value]
