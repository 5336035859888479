"""Placing a frame in the map: key points with known depths and the picture as a whole, fused into one pose."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.stats import chi2 as chi_square

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.models.classical import pose_information
from vggtgeo.models.roles import Features, GeometryResult, PointMatcher, PoseGuess, PoseQuery
from vggtgeo.slam.description import Description
from vggtgeo.slam.evidence import Evidence, step_chi2, step_information, tangent, worst_sigma
from vggtgeo.slam.factors import MeasuredRelativePose
from vggtgeo.slam.following import Located, located_by_flow
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.rgbd_alignment import Aligned
from vggtgeo.slam.rgbd_view import RgbdView
from vggtgeo.slam.settings import Roles

PIXEL_SIGMA = 2.0
"""Standard deviation of a match, pixels: 0.5 px of the key point, and the depth of the keyframe at that one pixel."""
SYSTEMATIC = (0.002, np.deg2rad(0.05), 0.01)
"""What no number of samples removes (calibration, rolling shutter, clocks): metres, radians, share of the motion.
Measured on pairs of frames, the dense alignment against the truth by the squared Mahalanobis distance, whose median
should be 5.3: where the truth is exact (icl-office) the samples' own information is right (3.7 to 5.4, 1 to 8 frames
apart). On the HoloLens clips, whose truth and camera are off by a pixel, it is 30 to 80 times that; with this floor 4.1
to 5.7 (1 and 3 frames apart)."""
AGREEMENT_GATE = float(chi_square.ppf(0.9999, 6))
"""Of the squared Mahalanobis distance between the poses by points and by the picture, below which they are averaged."""
LARGEST_DISAGREEMENT = 0.15
"""Metres between them, beyond which many points are believed rather than the picture."""


@dataclass(frozen=True, eq=False)
class Sight:
    """A frame as it is tracked. view: None where the map is tracked by points alone."""

    frame: Frame
    description: Description
    view: RgbdView | None

    @property
    def features(self) -> Features:
        """Its key points, found when they are first asked for."""
        return self.description.features


@dataclass(frozen=True, eq=False)
class Expectation:
    """Where motion so far leads. pose: float64 [4, 4], world -> camera. step: the last motion, camera -> camera.
    waited: frames since it was last confirmed.
    """

    pose: np.ndarray
    step: np.ndarray
    waited: int = 0


@dataclass(frozen=True, eq=False)
class Track:
    """A frame's pose against one keyframe.

    pose: float64 [4, 4], world -> camera. information: float64 [6, 6] of the motion from the keyframe to the frame,
    over its left tangent, translation first. result: why there is no pose, where there is none.
    """

    keyframe: Keyframe
    pose: np.ndarray
    information: np.ndarray
    evidence: Evidence
    result: GeometryResult

    @property
    def accepted(self) -> bool:
        return self.result is GeometryResult.SUCCESS and self.evidence.accepted

    @property
    def relative(self) -> np.ndarray:
        """Keyframe camera -> frame camera."""
        return self.pose @ rigid.invert(self.keyframe.pose)


def track(
    sight: Sight,
    keyframe: Keyframe,
    source: RgbdView | None,
    expected: Expectation | None,
    intrinsics: np.ndarray,
    roles: Roles,
    window: Iterable[Keyframe] = (),
) -> Track:
    """The pose of a frame from one keyframe: by its points, then by its picture and surface from there.

    source: the keyframe's view, where there is one. expected: None where nothing is known of the motion.
    window: keyframes that a model which looks at images may place the frame among.
    """
    views = None if source is None or sight.view is None else (source, sight.view)
    aligner = roles.alignment if views is not None else None
    located = None
    if aligner is not None and expected is not None and roles.flow is not None and roles.follows:
        located = located_by_flow(sight.frame.image, keyframe, expected.pose, intrinsics, roles.flow, roles.geometry)
    if located is None:
        matcher = roles.points if aligner is None else roles.coarse_points
        located = _by_descriptors(sight, keyframe, expected, intrinsics, matcher, roles, tuple(window))
    guess, matches = located.guess, located.matches
    known = guess.result is GeometryResult.SUCCESS
    dense = None
    if aligner is not None and views is not None and (known or expected):
        dense = aligner.align(*views, guess.pose @ rigid.invert(keyframe.pose))
    if not known and dense is None:
        return Track(keyframe, guess.pose, np.zeros((6, 6)), _seen(guess, len(matches)), guess.result)
    return _fused(keyframe, located, dense, expected, intrinsics)


def tie_between(first: Track, second: Track) -> MeasuredRelativePose:
    """What two tracks of one frame say of the motion between their keyframes."""
    motion = rigid.invert(second.relative) @ first.relative
    # Both errors are tangents at the frame; carried to the second keyframe by the adjoint of its motion.
    carry = rigid.adjoint(rigid.invert(second.relative))
    noise = np.linalg.inv(first.information) + np.linalg.inv(second.information)
    return MeasuredRelativePose(
        first.keyframe.number, second.keyframe.number, motion, np.linalg.inv(carry @ noise @ carry.T)
    )


def _by_descriptors(
    sight: Sight,
    keyframe: Keyframe,
    expected: Expectation | None,
    intrinsics: np.ndarray,
    matcher: PointMatcher,
    roles: Roles,
    window: tuple[Keyframe, ...],
) -> Located:
    """The pose by key points that match in their descriptors, as far as their depth is known."""
    matches = matcher.match(keyframe.features, sight.features)
    inverse_depth = keyframe.points.inverse_depth[matches.index_i]
    known = np.isfinite(inverse_depth)
    matches = matches.select(known)
    points = rigid.unproject(matches.pixels_i, inverse_depth[known], keyframe.pose, intrinsics)
    query = PoseQuery(
        sight.frame.image,
        intrinsics,
        points,
        matches.pixels_j,
        matches.confidence,
        None if expected is None else expected.pose,
        window_images=tuple(member.image for member in window),
        window_poses=tuple(member.pose for member in window),
        window_depths=tuple(member.depth for member in window) if roles.metric else (),
    )
    return Located(roles.geometry.locate(query), matches, points, PIXEL_SIGMA)


def _fused(
    keyframe: Keyframe,
    located: Located,
    dense: Aligned | None,
    expected: Expectation | None,
    intrinsics: np.ndarray,
) -> Track:
    """One pose from points, picture and, weakly, the motion: the mean by information, in the motion's tangent space."""
    back, guess = rigid.invert(keyframe.pose), located.guess
    evidence = _seen(guess, len(located.matches))
    by_points = None
    if guess.result is GeometryResult.SUCCESS:
        known = pose_information(guess.pose, located.points[guess.inliers], intrinsics, located.sigma)
        by_points = _Motion(guess.pose @ back, known)
    if dense is not None:
        evidence = _with_picture(evidence, dense)
    found = _agreed(by_points, dense, evidence)
    motion, information = found.motion, found.information
    if expected is not None:
        # A direction that is seen badly goes on as the motion did; what was measured does not gain by it.
        prior = step_information(expected.step) / (expected.waited + 1)
        off = tangent(expected.pose @ back @ rigid.invert(motion))
        motion = _moved(np.linalg.solve(information + prior, prior @ off)) @ motion
    information = _with_systematic(information, motion)
    sigma_translation, sigma_rotation = worst_sigma(information)
    pose = rigid.orthonormal(motion @ keyframe.pose)
    agreement = float("nan")
    if by_points is not None and dense is not None:
        agreement = float(np.linalg.norm(by_points.motion[:3, 3] - dense.motion[:3, 3]))
    evidence = replace(
        evidence,
        sigma_translation=sigma_translation,
        sigma_rotation=sigma_rotation,
        chi2=float("nan") if expected is None else step_chi2(pose, expected.pose, expected.step, expected.waited),
        agreement=agreement,
    )
    return Track(keyframe, pose, information, evidence, GeometryResult.SUCCESS)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Keyframe camera -> frame camera, and its information over the left tangent."""

    motion: np.ndarray
    information: np.ndarray


def _agreed(by_points: _Motion | None, dense: Aligned | None, evidence: Evidence) -> _Motion:
    """The mean of both where they agree to within their noise, else the one with the better evidence."""
    if dense is None:
        assert by_points is not None
        return by_points
    by_picture = _Motion(dense.motion, dense.information)
    if by_points is None:
        return by_picture
    off = tangent(by_points.motion @ rigid.invert(dense.motion))
    noise = [np.linalg.inv(_with_systematic(one.information, one.motion)) for one in (by_points, by_picture)]
    if off @ np.linalg.solve(noise[0] + noise[1], off) < AGREEMENT_GATE:
        both = by_points.information + dense.information
        mean = np.linalg.solve(both + 1e-9 * np.eye(6), by_points.information @ off)
        return _Motion(_moved(mean) @ dense.motion, both)
    # Points that lie on one plane, or few of them, are often some centimetres off: the picture mends that.
    near = np.linalg.norm(off[:3]) < LARGEST_DISAGREEMENT or not evidence.points_strong
    return by_picture if evidence.dense_fair and near else by_points


def _seen(guess: PoseGuess, matches: int) -> Evidence:
    return Evidence(matches=matches, inliers=guess.inlier_count, error=guess.error)


def _with_picture(evidence: Evidence, dense: Aligned) -> Evidence:
    return replace(
        evidence,
        correlation=dense.correlation,
        edges=dense.edges,
        surface=dense.surface,
        overlap=dense.overlap,
    )


def _with_systematic(information: np.ndarray, motion: np.ndarray) -> np.ndarray:
    length, angle = (np.linalg.norm(part) for part in np.split(tangent(motion), 2))
    metres, radians, share = SYSTEMATIC
    floor = np.repeat([metres + share * length, radians + share * angle], 3) ** 2
    return np.linalg.inv(np.linalg.inv(information + 1e-9 * np.eye(6)) + np.diag(floor))


def _moved(step: np.ndarray) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(step[3:])[0]
    motion[:3, 3] = step[:3]
    return motion
