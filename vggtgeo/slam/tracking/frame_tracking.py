"""Tracking of one frame: key points of known depth, dense alignment and lines, fused into one pose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.models.classical import pose_information
from vggtgeo.models.roles import (
    Features,
    GeometryResult,
    LineFeatures,
    PointMatcher,
    PointMatches,
    PoseGuess,
    PoseQuery,
)
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.perception.rgbd_alignment import Aligned
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import PIXEL_SIGMA, Keyframe
from vggtgeo.slam.tracking.flow_tracking import Located, located_by_flow
from vggtgeo.slam.tracking.local_map_tracking import joint_matches, refine_by_map
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality, step_chi2, step_information, worst_sigma
from vggtgeo.slam.tracking.pose_fusion import (
    Motion,
    agreed,
    fused_with_prior,
    metre_of,
    weakly_constrained,
    with_lines,
    with_systematic,
)
from vggtgeo.slam.tracking.tracking_state import FramePose, SeenPoints, Tracker
from vggtgeo.slam.tracking.two_view_motion import explains_more, may_explain_more, two_view_motion

ROUGH_RADIUS = 60.0
"""The same for a pose by the motion prior alone: its 6 degrees are 52 px at a focal length of 500."""


@dataclass(frozen=True, eq=False)
class FrameData:
    """Data of a frame for tracking. view: None without dense alignment. find_lines: detects and describes segments;
    None if they are not used.
    """

    frame: Frame
    description: Description
    view: RgbdView | None
    find_lines: Callable[[], LineFeatures] | None = None

    @cached_property
    def lines(self) -> LineFeatures | None:
        """The segments, detected on first access."""
        return None if self.find_lines is None else self.find_lines()

    @property
    def found_lines(self) -> LineFeatures | None:
        """The segments if they were detected, else None."""
        found: LineFeatures | None = self.__dict__.get("lines")
        return found

    @property
    def features(self) -> Features:
        """The key points, detected on first access."""
        return self.description.features


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Prediction from the motion so far. pose: float64 [4, 4], world -> camera. step: the last motion, camera ->
    camera. waited: frames since it was last confirmed.
    """

    pose: np.ndarray
    step: np.ndarray
    waited: int = 0

    def motion_from(self, keyframe: Keyframe) -> Motion:
        """Return the predicted motion from a keyframe, with its information."""
        information = step_information(self.step) / (self.waited + 1)
        return Motion(self.pose @ rigid.invert(keyframe.pose), information)


@dataclass(frozen=True, eq=False)
class TrackingInput:
    """A frame to be tracked, with prior knowledge.

    prior: None if the motion is unknown. window: keyframes whose images are given to a pose network.
    """

    data: FrameData
    intrinsics: np.ndarray
    roles: Roles
    prior: MotionPrior | None = None
    window: tuple[Keyframe, ...] = ()

    def views(self, source: RgbdView | None) -> tuple[RgbdView, RgbdView] | None:
        """Return the views of a keyframe and of the frame; None unless both exist."""
        return None if source is None or self.data.view is None else (source, self.data.view)


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame's pose relative to one keyframe.

    pose: float64 [4, 4], world -> camera. measured: float64 [6, 6], information of the motion keyframe -> frame over
    its left tangent, translation first, without systematic errors. result: the reason if there is no pose. alone: the
    track before other keyframes refined it. seen: its matches with the keyframe, if the pose is from points alone.
    matches: all matches with the keyframe, of known depth or not; None if the pose is not by descriptors of one
    keyframe.
    """

    keyframe: Keyframe
    pose: np.ndarray
    measured: np.ndarray
    quality: TrackingQuality
    result: GeometryResult
    alone: TrackedFrame | None = None
    seen: SeenPoints | None = None
    matches: PointMatches | None = None

    @property
    def accepted(self) -> bool:
        return self.result is GeometryResult.SUCCESS and self.quality.accepted

    @property
    def relative(self) -> np.ndarray:
        """Motion keyframe camera -> frame camera."""
        return self.pose @ rigid.invert(self.keyframe.pose)

    @property
    def information(self) -> np.ndarray:
        """Information with systematic errors."""
        return with_systematic(self.measured, self.relative)


def track(given: TrackingInput, keyframe: Keyframe, source: RgbdView | None) -> TrackedFrame:
    """Track a frame against one keyframe: by its points, then by dense alignment from there.

    source: the keyframe's view, or None.
    """
    roles, views = given.roles, given.views(source)
    aligner = roles.alignment if views is not None else None
    located = None
    if aligner is not None and given.prior is not None and roles.flow is not None and roles.follows:
        image, predicted = given.data.frame.image, given.prior.pose
        located = located_by_flow(image, keyframe, predicted, given.intrinsics, roles.flow, roles.geometry)
    if located is None:
        matcher = roles.points if aligner is None else roles.coarse_points
        located = _by_descriptors(given, keyframe, matcher)
    return _placed(given, keyframe, views, located)


def track_by_map(
    given: TrackingInput, keyframes: Iterable[Keyframe], reference: Keyframe, source: RgbdView | None
) -> TrackedFrame:
    """Track a frame by the points of all keyframes in view, if no keyframe alone has enough.

    Points are searched around the prediction. Dense alignment and lines use `reference`.
    """
    assert given.prior is not None
    data, predicted = given.data, given.prior.pose
    points, pixels, confidence = joint_matches(
        data.features, tuple(keyframes), predicted, given.intrinsics, ROUGH_RADIUS
    )
    query = PoseQuery(data.frame.image, given.intrinsics, points, pixels, confidence, predicted)
    located = Located(given.roles.geometry.locate(query), len(points), points, PIXEL_SIGMA)
    return _placed(given, reference, given.views(source), located)


def track_by_two_view(given: TrackingInput, keyframe: Keyframe, length: float) -> TrackedFrame | None:
    """Track a frame by matches with a keyframe of unknown depths; None if they do not determine the motion.

    length: of the motion between both, from the motion so far.
    """
    matches = given.roles.points.match(keyframe.features, given.data.features)
    return _placed_by_two_view(given, keyframe, length, matches)


def unless_contradicted(found: TrackedFrame, given: TrackingInput, keyframe: Keyframe, length: float) -> TrackedFrame:
    """Return the track, or the track by rays alone if it explains significantly more matches.

    keyframe, length: as for `track_by_two_view`. A track by another keyframe is returned as it is: the poses of both
    keyframes may differ by drift.
    """
    matches = found.matches
    if found.keyframe.number != keyframe.number or matches is None or found.quality.by_two_view:
        return found
    if not may_explain_more(found.relative, matches, given.intrinsics):
        return found
    other = _placed_by_two_view(given, keyframe, length, matches)
    if other is None or not other.accepted:
        return found
    better = explains_more(other.relative, found.relative, matches, given.intrinsics)
    return other if better else found


def _placed_by_two_view(
    given: TrackingInput, keyframe: Keyframe, length: float, matches: PointMatches
) -> TrackedFrame | None:
    found = two_view_motion(matches, length, given.intrinsics, given.roles.geometry, PIXEL_SIGMA)
    if found is None:
        return None
    agree = int(np.count_nonzero(found.inliers))
    metre = metre_of(found.points[found.inliers], np.eye(4))
    quality = TrackingQuality(matches=len(matches), inliers=agree, metre=metre, by_two_view=True)
    motion = Motion(found.motion, found.information)
    # Rays alone hardly determine the length of the motion; the prior adds it.
    motion = motion if given.prior is None else fused_with_prior(motion, given.prior.motion_from(keyframe))
    return _judged(rigid.orthonormal(motion.motion @ keyframe.pose), motion.information, quality, keyframe, None)


def _placed(
    given: TrackingInput, keyframe: Keyframe, views: tuple[RgbdView, RgbdView] | None, located: Located
) -> TrackedFrame:
    """Return the track from key points, refined by image, surface and lines; without points, from the motion prior."""
    guess, line_matcher = located.guess, given.roles.line_matches
    known = guess.result is GeometryResult.SUCCESS
    aligner, dense = given.roles.alignment, None
    # Dense alignment converges from near poses only: with neither a pose nor a prediction there is no start.
    if aligner is not None and views is not None and (known or given.prior):
        dense = aligner.align(*views, guess.pose @ rigid.invert(keyframe.pose))
    by_points = None
    if known:
        information = pose_information(guess.pose, located.points[guess.inliers], given.intrinsics, located.sigma)
        by_points = Motion(guess.pose @ rigid.invert(keyframe.pose), information)
    quality = _quality_of(guess, located.matches, dense)
    if known and not given.roles.metric:
        quality = replace(quality, metre=metre_of(located.points[guess.inliers], guess.pose))
    prior = None if given.prior is None else given.prior.motion_from(keyframe)
    # The prior enters after the measurements were compared: it must not make wrong ones agree.
    found = agreed(by_points, dense, quality)
    if found is not None and prior is not None:
        found = fused_with_prior(found, prior)
    # Finding lines costs as much as the alignment, so it is done only where it can help.
    needed = prior is not None if found is None else weakly_constrained(found)
    if needed and given.data.lines is not None:
        found, quality = with_lines(found, prior, quality, keyframe, given.data.lines, given.intrinsics, line_matcher)
    if found is None:
        nothing = np.zeros((6, 6))
        return TrackedFrame(keyframe, guess.pose, nothing, quality, guess.result, matches=located.with_unknown_depth)
    pose = rigid.orthonormal(found.motion @ keyframe.pose)
    track = _judged(pose, found.information, quality, keyframe, given.prior)
    track = replace(track, matches=located.with_unknown_depth)
    return replace(track, seen=located.seen) if known and dense is None else track


def refined_by_map(found: TrackedFrame, given: TrackingInput, keyframes: Iterable[Keyframe]) -> TrackedFrame:
    """Return the track refined by the points of all other keyframes in view if it is weakly constrained."""
    if not weakly_constrained(Motion(found.relative, found.measured)):
        return found
    known = found.keyframe, found.pose, found.information
    refined = refine_by_map(given.data.features, tuple(keyframes), *known, given.intrinsics)
    if refined is None:
        return found
    # Systematic errors, which more points do not reduce, are common to all keyframes: `information` adds them once.
    measured = found.measured + refined.information
    quality = replace(found.quality, map_points=refined.points)
    better = _judged(rigid.orthonormal(refined.pose), measured, quality, found.keyframe, given.prior)
    return replace(better, alone=found, seen=found.seen, matches=found.matches)


def moved_with(found: TrackedFrame, keyframe: Keyframe) -> TrackedFrame:
    """Return the track after its keyframe was adjusted: the measurement is the relative motion."""
    alone = None if found.alone is None else moved_with(found.alone, keyframe)
    return replace(found, keyframe=keyframe, pose=rigid.orthonormal(found.relative @ keyframe.pose), alone=alone)


def factor_to(found: TrackedFrame, number: int) -> MeasuredRelativePose:
    """Return the odometry factor of a frame that became keyframe `number`.

    Information from other keyframes is left out: it enters by their own edges and would count twice.
    """
    direct = found.alone or found
    return MeasuredRelativePose(
        *(direct.keyframe.number, number, direct.relative, direct.information),
        by_two_view=direct.quality.by_two_view,
        recorded=direct.quality.recorded,
    )


def factor_between(first: TrackedFrame, second: TrackedFrame) -> MeasuredRelativePose:
    """Return the relative-pose factor between the keyframes of two tracks of one frame."""
    first, second = first.alone or first, second.alone or second
    motion = rigid.invert(second.relative) @ first.relative
    # Both errors are tangents at the frame; carried to the second keyframe by the adjoint of its motion.
    carry = rigid.adjoint(rigid.invert(second.relative))
    noise = np.linalg.inv(first.information) + np.linalg.inv(second.information)
    return MeasuredRelativePose(
        first.keyframe.number, second.keyframe.number, motion, np.linalg.inv(carry @ noise @ carry.T)
    )


def _by_descriptors(given: TrackingInput, keyframe: Keyframe, matcher: PointMatcher) -> Located:
    """Return the pose from key points of known depth, matched by descriptors."""
    every = matcher.match(keyframe.features, given.data.features)
    inverse_depth = keyframe.points.inverse_depth[every.index_i]
    known = np.isfinite(inverse_depth)
    matches = every.select(known)
    points = rigid.unproject(matches.pixels_i, inverse_depth[known], keyframe.pose, given.intrinsics)
    query = PoseQuery(
        given.data.frame.image,
        given.intrinsics,
        points,
        matches.pixels_j,
        matches.confidence,
        None if given.prior is None else given.prior.pose,
        window_images=tuple(member.image for member in given.window),
        window_poses=tuple(member.pose for member in given.window),
        window_depths=tuple(member.depth for member in given.window) if given.roles.metric else (),
    )
    guess = given.roles.geometry.locate(query)
    return Located(guess, len(matches), points, PIXEL_SIGMA, matches.index_i, matches.pixels_j, every)


def _judged(
    pose: np.ndarray, measured: np.ndarray, quality: TrackingQuality, keyframe: Keyframe, prior: MotionPrior | None
) -> TrackedFrame:
    """Return a track with its standard deviations in the worst directions and its distance from the prior."""
    track = TrackedFrame(keyframe, pose, measured, quality, GeometryResult.SUCCESS)
    sigma_translation, sigma_rotation = worst_sigma(track.information)
    quality = replace(
        quality,
        sigma_translation=sigma_translation,
        sigma_rotation=sigma_rotation,
        chi2=float("nan") if prior is None else step_chi2(pose, prior.pose, prior.step, prior.waited),
    )
    return replace(track, quality=quality)


def _quality_of(guess: PoseGuess, matches: int, dense: Aligned | None) -> TrackingQuality:
    """Return the measures of a pose by points, and of the dense alignment if there is one."""
    quality = TrackingQuality(matches=matches, inliers=guess.inlier_count)
    if dense is None:
        return quality
    return replace(quality, correlation=dense.correlation, surface=dense.surface, overlap=dense.overlap)


def view_of(keyframe: Keyframe, tracker: Tracker, intrinsics: np.ndarray, roles: Roles) -> RgbdView | None:
    """Return a keyframe's view for the alignment: stored for the reference, else computed."""
    if roles.alignment is None:
        return None
    if tracker.reference is not None and tracker.reference[0] == keyframe.number:
        return tracker.reference[1]
    depth = keyframe.depth.astype(np.float32), keyframe.depth_sigma.astype(np.float32)
    return RgbdView.of(keyframe.image, depth, intrinsics)


def frame_data(frame: Frame, description: Description, intrinsics: np.ndarray, roles: Roles, metric: bool) -> FrameData:
    """Return the frame's data for tracking. metric: whether lengths of the map are metres."""
    view = None
    if roles.alignment is not None and metric:
        view = description.view_by(intrinsics)
        view = view or RgbdView.of(frame.image, roles.tracking_depth(frame.depth), intrinsics)
    return FrameData(frame, description, view)


def record_of(frame: Frame, found: TrackedFrame) -> FramePose:
    """Return the record of a tracked frame relative to its keyframe."""
    return FramePose(
        frame.index,
        frame.timestamp,
        found.keyframe.number,
        found.relative,
        True,
        found.quality.inliers,
        found.quality,
        seen=found.seen,
    )
