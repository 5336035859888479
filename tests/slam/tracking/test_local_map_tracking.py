"""A pose by the points of several keyframes: brought right, its covariance honest, a drifted keyframe left out.

Exact truth: the renderer's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from vggtgeo.models.classical import SiftMatcher, search_near, search_tree

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.simulation import simulate
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe, make_keyframe
from vggtgeo.slam.tracking.frame_tracking import (
    FrameData,
    MotionPrior,
    TrackingInput,
    factor_to,
    refined_by_map,
    track,
    track_by_map,
)
from vggtgeo.slam.tracking.local_map_tracking import Refined, refine_by_map
from vggtgeo.slam.tracking.pose_acceptance import tangent

SIZE = (320, 240)
ROLES = Roles(points=SiftMatcher(count=500))
OFF = exponential(np.array([0.008, -0.006, 0.008, 0.004, -0.004, 0.003]))
VAGUE = np.diag(1.0 / np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01]) ** 2)
View = tuple[tuple[Keyframe, ...], Keyframe, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def view() -> View:
    """Keyframes at frames 0, 3, 6 of a room; frame 8 with its features; the true pose; intrinsics."""
    sequence = simulate("room", 30, 0, SIZE, rate=10.0)
    truth = sequence.ground_truth()
    intrinsics = np.array(sequence.camera.intrinsics)
    poses = rigid.invert(truth.poses)
    made = []
    for number, index in enumerate((0, 3, 6, 8)):
        frame = sequence.frame(index)
        features = ROLES.points.describe(frame.image)
        made.append(
            make_keyframe(number, frame, poses[index], Description.of(features), ROLES, SlamSettings(), intrinsics)
        )
    return tuple(made[:3]), made[3], poses[8], intrinsics


def _refined(
    view: View, keyframes: tuple[Keyframe, ...], start: np.ndarray, known: np.ndarray = VAGUE
) -> Refined | None:
    frame, intrinsics = view[1], view[3]
    return refine_by_map(frame.features, keyframes, frame, start, known, intrinsics)


def test_points_of_several_keyframes_bring_a_pose_right(view: View) -> None:
    """From 13 mm and 0.4 degrees off, a pose known vaguely comes to 6 mm of the truth, three keyframes tell more than
    one, and the error is within 4 of the stated standard deviations. Oracle: the renderer's pose.
    """
    keyframes, _, true, _ = view
    found, alone = (_refined(view, some, OFF @ true) for some in (keyframes, keyframes[:1]))
    assert (found.keyframes, alone.keyframes) == (3, 1)
    off = tangent(found.pose @ rigid.invert(true))
    assert np.linalg.norm(off[:3]) < 0.006, f"{1000 * np.linalg.norm(off[:3]):.1f} mm"
    assert off @ (found.information + VAGUE) @ off < 6 * 4**2
    more = np.linalg.eigvalsh(found.information - alone.information)
    assert more[0] > 0, "each keyframe adds to every direction"


def test_a_keyframe_that_drifted_is_left_out(view: View) -> None:
    """A keyframe that stands 5 cm beside its place does not pull a pose that is known to 2 mm. Oracle: the same without
    that keyframe.
    """
    keyframes, _, true, _ = view
    aside = np.eye(4)
    aside[0, 3] = 0.05
    drifted = replace(keyframes[1], pose=aside @ keyframes[1].pose)
    sure = np.diag(1.0 / np.array([0.002, 0.002, 0.002, 0.001, 0.001, 0.001]) ** 2)
    found = _refined(view, (keyframes[0], drifted, keyframes[2]), true, sure)
    without = _refined(view, (keyframes[0], keyframes[2]), true, sure)
    assert found.keyframes == 2
    np.testing.assert_allclose(found.pose, without.pose, atol=1e-9)


def test_a_tie_counts_what_other_keyframes_know_only_once(view: View) -> None:
    """A pose that the points of others refined ties a new keyframe by what its own keyframe measured.

    Oracle: the track before the refinement.
    """
    keyframes, frame, true, intrinsics = view
    data = FrameData(Frame(8, 0.8, frame.image, None, ""), Description.of(frame.features), None)
    expected = MotionPrior(true, np.eye(4))
    given = TrackingInput(data, intrinsics, ROLES, expected)
    own = track(given, keyframes[2], None)
    refined = refined_by_map(own, given, keyframes)
    assert refined.quality.map_points > 0
    assert np.linalg.eigvalsh(refined.measured - own.measured)[0] > 0
    tie = factor_to(refined, 9)
    assert tie.keyframes == (2, 9)
    np.testing.assert_allclose(tie.information, own.information)
    np.testing.assert_allclose(tie.pose, own.relative)


def test_keyframes_with_too_few_points_each_place_a_frame_together(view: View) -> None:
    """Three keyframes that know ten points each: none places the frame alone, together they bring a pose that is 8 cm
    and 3 degrees off to 1 cm of the truth, and it is believed. Oracle: the renderer's pose.
    """
    keyframes, frame, true, intrinsics = view
    poor = tuple(_knowing(keyframe, frame, true, intrinsics, 10) for keyframe in keyframes)
    wrong = exponential(np.array([0.05, -0.04, 0.04, 0.03, -0.035, 0.02])) @ true
    data = FrameData(Frame(8, 0.8, frame.image, None, ""), Description.of(frame.features), None)
    given = TrackingInput(data, intrinsics, ROLES, MotionPrior(wrong, np.eye(4)))
    for keyframe in poor:
        assert not track(given, keyframe, None).accepted
    found = track_by_map(given, poor, poor[-1], None)
    off = np.linalg.norm(rigid.centre(found.pose) - rigid.centre(true))
    assert found.accepted, found.quality
    assert off < 0.01, f"{100 * off:.1f} cm"


def _knowing(keyframe: Keyframe, frame: Keyframe, true: np.ndarray, intrinsics: np.ndarray, count: int) -> Keyframe:
    """The keyframe with the depths of only so many points that the frame shows."""
    inverse = keyframe.points.inverse_depth
    known = np.nonzero(np.isfinite(inverse))[0]
    points = rigid.unproject(keyframe.features.pixels[known], inverse[known], keyframe.pose, intrinsics)
    pixels = rigid.project(points, true, intrinsics)
    seen = search_near(keyframe.features, known, pixels, frame.features, search_tree(frame.features), radius=4.0)
    kept = seen.index_i[:: max(len(seen) // count, 1)][:count]
    assert len(kept) == count
    inverse = np.where(np.isin(np.arange(len(inverse)), kept), inverse, np.nan)
    return replace(keyframe, points=replace(keyframe.points, inverse_depth=inverse))


def test_a_match_is_searched_where_it_must_be(view: View) -> None:
    """Key points searched in their own image are found at themselves, and none when all are said to be 50 px away.

    Oracle: identity.
    """
    features = view[1].features
    index = np.arange(len(features))
    tree = search_tree(features)
    found = search_near(features, index, features.pixels, features, tree, radius=3.0)
    assert len(found) > 0.8 * len(index)
    np.testing.assert_array_equal(found.index_i, found.index_j)
    away = search_near(features, index, features.pixels + [50.0, 0.0], features, tree, radius=3.0)
    assert len(away) < 0.02 * len(index)
