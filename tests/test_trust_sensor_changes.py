"""A map whose lens, or unit of measured depth, changes; oracle: the factor, and the keyframe that it begins at."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from matched_slam import matched_slam
from scipy.spatial.transform import Rotation
from test_trust_sensor_drift import K

from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.sensor_drift import (
    MOST_CHANGE,
    MOST_SIGMA,
    REACH,
    WITHIN,
    Ratios,
    changes,
    check_sensors,
    compare,
    directed_pairs,
    statements,
)

KEYFRAMES, POINTS, AT = 40, 60, 17
FACTOR = 1.15


def _walk(focal: float = 1.0, unit: float = 1.0, noise: float = 0.01, poses_off: bool = False) -> Slam:
    """A walk past points 3 to 8 m away, each keyframe matched with the three before it. From keyframe `AT` on the focal
    length, or the depth that is measured, is so many times as long. noise: relative, of depth. poses_off: the map has
    every step as long as its depth says.
    """
    rng = np.random.default_rng(0)
    world = rng.uniform((-2, -2, 3), (2, 2, 8), (POINTS, 3))
    poses = np.tile(np.eye(4), (KEYFRAMES, 1, 1))
    for number, pose in enumerate(poses):
        pose[:3, :3] = Rotation.from_rotvec([0.0, 0.1 * np.sin(0.2 * number), 0.0]).as_matrix()
        pose[:3, 3] = pose[:3, :3] @ (-1.5 * np.sin(0.1 * number), 0.1 * np.cos(0.4 * number), -0.02 * number)
    slam = matched_slam(world, poses)
    changed = []
    for keyframe in slam.keyframes:
        lens, metres = (focal, unit) if keyframe.number >= AT else (1.0, 1.0)
        measured = metres / keyframe.points.inverse_depth * (1 + rng.normal(0, noise, POINTS))
        pixels = K[2:] + lens * (keyframe.points.pixels - K[2:])
        points = replace(keyframe.points, pixels=pixels, prior=1 / measured)
        pose = keyframe.pose.copy()
        pose[:3, 3] *= metres if poses_off else 1.0
        changed.append(replace(keyframe, points=points, pose=pose))
    return _seen(slam, changed)


def _seen(slam: Slam, keyframes: list[Keyframe]) -> Slam:
    """The state with these keyframes, whose neighbours match at the pixels that they have now."""
    near = [pair for pair in slam.map.pairs if pair.second - pair.first <= REACH]
    pixels_of = lambda number: keyframes[number].points.pixels
    pairs = tuple(
        replace(p, points=replace(p.points, pixels_i=pixels_of(p.first), pixels_j=pixels_of(p.second))) for p in near
    )
    return replace(
        slam,
        camera=replace(slam.camera, intrinsics=K),
        map=replace(slam.map, metric=True, keyframes=tuple(keyframes), pairs=pairs),
    )


def test_a_sensor_that_stays_is_told_nothing() -> None:
    """One lens and one unit, with 1 and 4 % of noise in each depth."""
    for noise in (0.01, 0.04):
        slam = _walk(noise=noise)
        said = statements(slam)
        assert {place for pair in said.unit.numbers.tolist() for place in pair} == set(range(KEYFRAMES))
        assert list(check_sensors(slam)) == []


@pytest.mark.parametrize("factor", [FACTOR, 1 / FACTOR])
@pytest.mark.parametrize("poses_off", [False, True])
def test_a_unit_that_jumps_is_told(factor: float, poses_off: bool) -> None:
    """By its factor, around its two keyframes, whatever the map made of it."""
    slam = _walk(unit=factor, poses_off=poses_off)
    (finding,) = check_sensors(slam)
    assert finding.scale
    assert "the unit of the sensor's depth changes, by a factor" in finding.text
    ((first, last, value),) = changes(statements(slam).unit, np.zeros(KEYFRAMES), WITHIN)
    assert (finding.start, finding.end) == (first, last)
    assert AT - 6 <= first < AT <= last <= AT + 6
    assert value == pytest.approx(np.log(factor), abs=0.02)


def test_a_lens_that_jumps_is_told() -> None:
    """By its factor; the unit of depth, which stays, is not blamed."""
    (finding,) = check_sensors(_walk(focal=FACTOR))
    assert not finding.scale
    assert finding.start is not None
    assert finding.end is not None
    assert AT - 6 <= finding.start < AT <= finding.end <= AT + 6
    value = float(finding.text.split("the lens zooms: the focal length changes, by a factor of ")[1][:4])
    assert value == pytest.approx(FACTOR, abs=0.02)


@pytest.mark.parametrize("length", [1, 10, 60])
def test_changes_over_any_number_of_keyframes_are_told(length: int) -> None:
    """A factor of 1.12 over one, ten, and sixty places of 140, each pair of keyframes off by 0.004; nothing else, and
    where a stretch of keyframes says nothing, nothing over that. Oracle: where it was put.
    """
    rng = np.random.default_rng(0)
    truth = np.log(1.12) * np.clip((np.arange(140) - 30) / length, 0, 1)
    said = _said(truth, rng.normal(0, 0.004, (140, REACH)))
    ((first, last, value),) = changes(said, np.zeros(140), WITHIN)
    assert value == pytest.approx(np.log(1.12), abs=0.03)
    assert 30 - 8 <= first < last <= 30 + length + 8
    assert changes(_said(0 * truth, rng.normal(0, 0.004, (140, REACH))), np.zeros(140), WITHIN) == []
    gap = (said.numbers.min(1) < 30 + length) & (said.numbers.max(1) > 30)
    assert changes(said.rows(~gap), np.zeros(140), WITHIN) == []
    assert changes(said.apart_from([(30, 30 + length, 0.1)]), np.zeros(140), WITHIN) == []
    assert changes(said.rows(np.zeros(len(gap), bool)), np.zeros(140), WITHIN) == []
    assert changes(said.rows(np.zeros(len(gap), bool)), np.zeros(0), WITHIN) == []


def test_chance_and_one_bad_picture_are_not_told() -> None:
    """Pairs that are off by 0.05 each, and know it, and pairs that do not; a keyframe that is off by 0.2 alone."""
    rng = np.random.default_rng(0)
    for stated in (0.015, 0.001):
        drawn = [_said(np.zeros(100), rng.normal(0, 0.015, (100, REACH)), stated) for _ in range(20)]
        assert [said for said in drawn if changes(said, np.zeros(100), WITHIN)] == []
    truth = np.zeros(40)
    truth[AT] = 0.2
    assert changes(_said(truth, rng.normal(0, 0.002, (40, REACH))), np.zeros(40), WITHIN) == []


def _said(truth: np.ndarray, off: np.ndarray, sigma: float = 0.004) -> Ratios:
    """Of float64 [n] keyframes, each with the next ones, both ways; off: [n, REACH], of each pair."""
    pairs = [(n, n + apart) for n in range(len(truth)) for apart in range(1, REACH + 1) if n + apart < len(truth)]
    values = [(float(truth[j] - truth[i] + off[i, j - i - 1]), sigma) for i, j in pairs]
    return Ratios.of([*pairs, *(pair[::-1] for pair in pairs)], [*values, *((-value, s) for value, s in values)])


def test_a_way_straight_to_a_wall_says_nothing_of_the_lens() -> None:
    """The wall grows alike by a longer lens and by coming nearer: by their own deviation pairs do not know the lens,
    whose values are as large as a zoom's, and are not asked; the unit of depth they know.
    """
    rng = np.random.default_rng(0)
    wall = rng.uniform((-2, -2, 5.95), (2, 2, 6.05), (POINTS, 3))
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 2, 3] = -0.15 * np.arange(12)
    slam = matched_slam(wall, poses)
    seen = []
    for keyframe in slam.keyframes:
        pixels = keyframe.points.pixels + rng.normal(0, 0.3, (POINTS, 2))
        prior = keyframe.points.inverse_depth * (1 + rng.normal(0, 0.01, POINTS))
        seen.append(replace(keyframe, points=replace(keyframe.points, pixels=pixels, prior=prior)))
    slam = _seen(slam, seen)
    found = [compare(pair, K).focal for pair in directed_pairs(slam, list(slam.map.pairs))]
    assert min(sigma for _, sigma in found) > MOST_SIGMA
    assert max(abs(value) for value, _ in found) > MOST_CHANGE
    said = statements(slam)
    assert len(said.focal.value) == 0
    assert len(said.unit.value) > 0
    assert list(check_sensors(slam)) == []


def test_what_is_below_the_bar_and_what_one_pair_says_is_not_told() -> None:
    """Half of what is told; a pair whose matches are of something that has another depth in one of its pictures alone;
    a keyframe that one pair joins to the rest.
    """
    assert list(check_sensors(_walk(unit=float(np.exp(MOST_CHANGE / 2))))) == []
    slam, few = _walk(), np.arange(POINTS // 3)
    keyframe = slam.keyframes[AT]
    prior = keyframe.points.prior.copy()
    prior[few] /= 1.3
    other = replace(keyframe, points=replace(keyframe.points, prior=prior))
    keyframes = (*slam.keyframes[:AT], other, *slam.keyframes[AT + 1 :])
    only = lambda m: replace(m, **{field.name: getattr(m, field.name)[few] for field in fields(m)})
    pairs = tuple(replace(p, points=only(p.points)) if p.key == (AT - 1, AT) else p for p in slam.map.pairs)
    assert list(check_sensors(replace(slam, map=replace(slam.map, keyframes=keyframes, pairs=pairs)))) == []
    jumped = _walk(unit=FACTOR)
    crossing = [pair for pair in jumped.map.pairs if pair.first < AT <= pair.second]
    kept = tuple(pair for pair in jumped.map.pairs if pair not in crossing or pair.key == (AT - 1, AT))
    assert list(check_sensors(replace(jumped, map=replace(jumped.map, pairs=kept)))) == []
