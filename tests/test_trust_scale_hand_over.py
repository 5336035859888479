"""How well keyframes without measured depth hand their scale on to each other."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from test_keyframe_depth import SIZE, keyframe
from vggtgeo.models.roles import Features, PointMatches

from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.global_map.pose_uncertainty import SHARED_ERRORS
from vggtgeo.slam.sparse_map.covisibility import Pair, without_matches
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Slots
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracker import FramePose, Tracker
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.scale_hand_over import ALONE, check_hand_over, hand_over_sigma

K = np.array([500.0, 500.0, 320.0, 240.0])
POINTS, REACH = 60, 3


def _walk(steps: list[float], across: dict[int, int] | None = None) -> Slam:
    """Keyframes side by side, so many metres from each to the next, that see the same points 3 to 5 m away. across: how
    many of them are matched from the keyframes up to the one named to those behind it.
    """
    rng = np.random.default_rng(0)
    depth = rng.uniform(3.0, 5.0, POINTS)
    world = np.stack([rng.uniform(-1, 1, POINTS) * depth, rng.uniform(-0.5, 0.5, POINTS) * depth, depth], 1)
    keyframes, unknown, one = [], np.full(POINTS, np.nan), np.ones(POINTS)
    for number, place in enumerate(np.cumsum([0.0, *steps])):
        pose = np.eye(4)
        pose[0, 3] = -place
        pixels = K[:2] * (world - [place, 0, 0])[:, :2] / depth[:, None] + K[2:]
        slots = Slots(pixels, 1 / depth, unknown, unknown, one, one)
        made = replace(keyframe(number, np.ones(SIZE), slots), pose=pose)
        keyframes.append(replace(made, features=Features(pixels, one)))
    pairs, ties = [], []
    for second in range(1, len(keyframes)):
        for first in range(max(second - REACH, 0), second):
            counts = [count for step, count in (across or {}).items() if first <= step < second]
            pairs.append(
                _pair(first, second, keyframes[first].points, keyframes[second].points, min([POINTS, *counts]))
            )
        motion = keyframes[second].pose @ np.linalg.inv(keyframes[second - 1].pose)
        ties.append(MeasuredRelativePose(second - 1, second, motion, np.eye(6)))
    records = [FramePose(k.frame, k.timestamp, k.number, np.eye(4), True, POINTS) for k in keyframes]
    state = Slam(
        map=Map(metric=False, keyframes=tuple(keyframes), pairs=tuple(pairs)),
        camera=CameraEstimate(intrinsics=K, given=K, sigma=np.ones(4)),
        tracker=Tracker(frames=tuple(records)),
    )
    return replace(state, map=replace(state.map, factors=tuple(ties), roots=(0,)))


def _pair(first: int, second: int, before: Slots, after: Slots, count: int) -> Pair:
    rows = np.arange(count)
    points = PointMatches(rows, rows, before.pixels[rows], after.pixels[rows], np.ones(count))
    return replace(without_matches(first, second), points=points)


def test_the_scale_of_two_stereo_pairs_is_handed_on_as_well_as_stated() -> None:
    """Two keyframes 20 cm apart, then two 10 cm apart: by how much the depths of either differ from those of the other
    where their disparities have a pixel of noise. Oracle: 4,000 trials.
    """
    slam = _walk([0.2, 0.05, 0.1])
    sigma = hand_over_sigma(slam)
    assert np.isnan(sigma[[0, 2]]).all()  # one keyframe has no scale
    matches = SHARED_ERRORS * (sigma[1] ** -2 - ALONE**-2)  # without the tracked motion, each for itself
    rng, inverse = np.random.default_rng(1), slam.keyframes[0].points.inverse_depth
    before, after = (K[0] * base * inverse for base in (0.2, 0.1))
    noisy = [np.log(one + rng.normal(0, 1, (4000, POINTS))) - np.log(one) for one in (before, after)]
    weight = 1 / (before**-2 + after**-2)
    off = ((noisy[1] - noisy[0]) * weight).sum(1) / weight.sum()
    assert off.std() == pytest.approx(matches**-0.5, rel=0.1)


@pytest.mark.parametrize(("across", "told"), [({}, False), ({8: 2}, True)])
def test_a_scale_that_little_hands_on_is_told(across: dict[int, int], told: bool) -> None:
    """Nineteen keyframes that stand nearly still for eight, and share two points from the ninth to the next ones: told,
    with where that is. Where they share sixty it is not.
    """
    slam = _walk([0.1] * 5 + [0.03] * 8 + [0.1] * 5, across)
    found = check_hand_over(slam)
    assert [finding.check for finding in found] == ["scale"] * told
    # The next keyframes know the depth of those two alone, too.
    assert all(re.search("fewest at frame (8|9|10):", finding.text) for finding in found)
    assert any("is handed on by few" in reason for reason in judge(slam).reasons) == told
    assert check_hand_over(replace(slam, map=replace(slam.map, metric=True))) == []


def test_a_step_at_the_end_moves_nothing() -> None:
    """What the last of forty frames have of a wrong scale is no matter of the path."""
    steps = [0.1] * 39
    assert check_hand_over(_walk(steps, {37: 0})) == []
    assert check_hand_over(_walk(steps, {20: 0})) != []


def test_matches_that_are_no_key_points_say_nothing() -> None:
    """Oracle: a dense matcher's targets are of no landmark, so that nobody knows what is handed on."""
    slam = _walk([0.1] * 15, {7: 0})
    dense = [replace(p, points=replace(p.points, index_j=np.full(len(p.points), -1))) for p in slam.map.pairs]
    assert check_hand_over(slam) != []
    assert check_hand_over(replace(slam, map=replace(slam.map, pairs=tuple(dense)))) == []
