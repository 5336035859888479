"""A motion from matches whose depths are not known: rotation, direction, and the length by what there is.

Exact truth: points and poses that were drawn.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest
from posed_keyframes import keyframe_of
from vggtgeo.models.classical import PnpGeometry
from vggtgeo.models.roles import GeometryResult, LineFeatures, PointMatches, Segments

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.run import default_roles
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.tracking.frame_tracking import FrameData, TrackedFrame, TrackingInput, track, unless_contradicted
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality, tangent
from vggtgeo.slam.tracking.two_view_motion import two_view_motion, usual_step

INTRINSICS = np.array([400.0, 400.0, 239.5, 134.5])
TRUE = exponential(np.array([0.30, 0.05, 0.10, 0.02, 0.50, -0.03]))
NOISE = 0.3
LINES = LineFeatures(Segments(np.zeros((0, 2, 2)), np.zeros(0)), np.zeros((0, 1)))


class Views(NamedTuple):
    """A keyframe that sees points, and its matches with a frame after the motion `TRUE`."""

    keyframe: Keyframe
    matches: PointMatches


def _views() -> Views:
    """Points 2 to 12 m away whose depth the keyframe does not know; matches with noise."""
    draw = np.random.default_rng(3)
    pixels = draw.uniform([200, 20], [460, 250], (1200, 2))
    inverse = 1.0 / draw.uniform(2.0, 12.0, len(pixels))
    points = pinhole.rays(pixels, INTRINSICS) / inverse[:, None]
    seen = pinhole.project(points @ TRUE[:3, :3].T + TRUE[:3, 3], INTRINSICS)
    inside = ((seen > 0) & (seen < [480, 270])).all(1)
    pixels, inverse, seen = pixels[inside], inverse[inside], seen[inside] + draw.normal(0, NOISE, (inside.sum(), 2))
    count = len(pixels)
    nothing, ones = np.full(count, np.nan), np.ones(count)
    slots = Slots(pixels, nothing, nothing, nothing, ones, ones, nothing)
    keyframe = keyframe_of(0, np.zeros((270, 480, 3), np.uint8), np.eye(4), slots, np.zeros((270, 480)))
    keyframe = replace(keyframe, lines=LINES)
    rows = np.arange(count)
    return Views(keyframe, PointMatches(rows, rows, pixels, seen, ones))


def test_a_motion_without_known_depths() -> None:
    """Rotation and direction of a motion come right to 0.3 and 2 degrees from matches alone; its length is the expected
    one, twice too long. Oracle: the motion that was drawn.
    """
    length = float(np.linalg.norm(TRUE[:3, 3]))
    found = two_view_motion(_views().matches, 2 * length, INTRINSICS, PnpGeometry(), NOISE)
    assert np.degrees(rigid.angle_between(found.motion, TRUE)) < 0.3
    cosine = found.motion[:3, 3] @ TRUE[:3, 3] / (2 * length * length)
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 2.0


def test_the_information_says_that_the_length_is_a_guess() -> None:
    """Along the motion the stated deviation is 70 % of the length, that of the motion so far; across it, and of the
    rotation, what matches tell: the error there is within 4 stated deviations. Oracle: the motion that was drawn.
    """
    length = float(np.linalg.norm(TRUE[:3, 3]))
    found = two_view_motion(_views().matches, length, INTRINSICS, PnpGeometry(), NOISE)
    along = np.append(found.motion[:3, 3] / np.linalg.norm(found.motion[:3, 3]), np.zeros(3))
    deviation = 1.0 / np.sqrt(along @ found.information @ along)
    assert deviation / length == pytest.approx(0.7, rel=0.01)
    off = tangent(found.motion @ rigid.invert(TRUE))
    assert off @ found.information @ off < 6 * 4**2


def test_a_motion_by_wrong_depths_is_replaced() -> None:
    """A track that moves the opposite way, and turns by what makes up for it, gives way to the motion of the epipolar
    lines, within 0.3 degrees. The right motion stays, though noise leaves outliers. Oracle: the motion that was drawn.
    """
    keyframe, matches = _views()
    opposite = exponential(np.array([-0.30, -0.05, -0.10, 0.02, 0.62, -0.03]))
    found = unless_contradicted(_tracked(keyframe, matches, opposite), _given(keyframe), keyframe, 0.3)
    assert np.degrees(rigid.angle_between(found.relative, TRUE)) < 0.3
    assert found.quality.by_two_view

    noisy = replace(
        matches, pixels_j=matches.pixels_j + np.random.default_rng(4).normal(0, 1.2, matches.pixels_j.shape)
    )
    right = _tracked(keyframe, noisy, TRUE)
    assert unless_contradicted(right, _given(keyframe), keyframe, 0.3) is right


def test_matches_are_kept_where_no_depth_is_known() -> None:
    """A track that has no pose, for lack of depths, keeps the matches that contradict a pose by other keyframes."""
    keyframe, matches = _views()
    given = _given(keyframe)
    roles = replace(given.roles, points=Mock(match=lambda features, other: matches))
    found = track(replace(given, roles=roles), keyframe, None)
    assert not found.accepted
    assert found.matches is matches


def _tracked(keyframe: Keyframe, matches: PointMatches, motion: np.ndarray) -> TrackedFrame:
    information = 1e6 * np.eye(6)
    return TrackedFrame(keyframe, motion, information, TrackingQuality(), GeometryResult.SUCCESS, matches=matches)


def _given(keyframe: Keyframe) -> TrackingInput:
    frame = Frame(1, 0.1, keyframe.image, None, "1")
    return TrackingInput(FrameData(frame, Description.of(keyframe.features), None), INTRINSICS, default_roles(False))


def test_the_usual_step_goes_on_at_the_speed_between_the_newest_keyframes() -> None:
    """Two keyframes 0.2 apart in two frames lead to 0.3 in three more. Oracle: the rule of three."""
    keyframe = _views().keyframe
    second = replace(keyframe, number=1, frame=2, pose=exponential(np.array([0.2, 0, 0, 0, 0, 0])))
    assert usual_step((keyframe, second), 5) == pytest.approx(0.3)
    assert usual_step((keyframe,), 5) == 0.0
