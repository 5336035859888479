"""A lens, and a unit of measured depth, that change at once; oracle: the factor, and the keyframe that it begins at."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from matched_slam import matched_slam
from scipy.spatial.transform import Rotation
from test_trust_sensor_drift import K

from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.sensor_drift import check_sensors, compare, directed_pairs
from vggtgeo.slam.trust.sensor_jumps import (
    MOST_CHANGE,
    MOST_SIGMA,
    REACH,
    WITHIN,
    check_jumps,
    neighbour_factors,
    sudden_changes,
)

KEYFRAMES, POINTS, AT = 40, 60, 17
FACTOR = 1.15


def _walk(focal: float = 1.0, unit: float = 1.0, noise: float = 0.01, poses_off: bool = False) -> Slam:
    """A walk past points 3 to 8 m away, each keyframe matched with the two before it. From keyframe `AT` on the focal
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
    near = [pair for pair in slam.pairs if pair.second - pair.first <= REACH]
    pixels_of = lambda number: keyframes[number].points.pixels
    pairs = tuple(
        replace(p, points=replace(p.points, pixels_i=pixels_of(p.first), pixels_j=pixels_of(p.second))) for p in near
    )
    return replace(slam, intrinsics=K, metric=True, keyframes=tuple(keyframes), pairs=pairs)


def test_a_sensor_that_stays_is_told_nothing() -> None:
    """One lens and one unit, with 1 and 4 % of noise in each depth."""
    for noise in (0.01, 0.04):
        slam = _walk(noise=noise)
        factors = neighbour_factors(slam)
        assert factors.shape == (KEYFRAMES - 1, 2)
        assert np.isfinite(factors[1:]).all()
        assert list(check_jumps(slam)) == []


@pytest.mark.parametrize("factor", [FACTOR, 1 / FACTOR])
@pytest.mark.parametrize("poses_off", [False, True])
def test_a_unit_that_jumps_is_told(factor: float, poses_off: bool) -> None:
    """By its factor, between its two keyframes, whatever the map made of it; steady changes are no match for it."""
    slam = _walk(unit=factor, poses_off=poses_off)
    assert check_sensors(slam) == []
    (finding,) = check_jumps(slam)
    assert finding.scale
    assert f"frames {AT - 1} to {AT}: the unit of the sensor's depth" in finding.text
    factors = neighbour_factors(slam)
    assert factors[AT - 1, 1] == pytest.approx(np.log(factor), abs=0.02)
    assert np.nanmax(np.abs(np.delete(factors[:, 1], AT - 1))) < 0.02


def test_a_lens_that_jumps_is_told() -> None:
    """By its factor; the unit of depth, which stays, is not blamed."""
    (finding,) = check_jumps(_walk(focal=FACTOR))
    assert not finding.scale
    assert f"frames {AT - 1} to {AT}: the focal length changes, by a factor of {FACTOR:.2f}" in finding.text


def test_changes_within_some_keyframes_are_told_and_steady_ones_are_not() -> None:
    """A factor of 1.2 over one, ten, and sixty places, with places that say nothing; oracle: where it was put."""
    rng = np.random.default_rng(0)
    for length in (1, 10, 60):
        steps = rng.normal(0, 0.004, 120)
        steps[30 : 30 + length] += np.log(1.2) / length
        steps[[5, 70, 90]] = np.nan
        found = sudden_changes(steps)
        if length > WITHIN:
            assert found == []
            continue
        assert len(found) == 1
        first, last, value = found[0]
        assert (first, last) == pytest.approx((30, 30 + length), abs=1)
        assert value == pytest.approx(np.log(1.2), abs=0.03)
    assert sudden_changes(np.full(5, np.nan)) == []
    assert sudden_changes(np.zeros(0)) == []
    noisy = [sudden_changes(rng.normal(0, 0.03, 200)) for _ in range(20)]
    assert sum(map(len, noisy)) <= 1, "what a run's own spread explains"


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
    found = [compare(pair, K).focal for pair in directed_pairs(slam, list(slam.pairs))]
    assert min(sigma for _, sigma in found) > MOST_SIGMA
    assert max(abs(value) for value, _ in found) > MOST_CHANGE
    factors = neighbour_factors(slam)
    assert np.isnan(factors[:, 0]).all()
    assert np.isfinite(factors[:, 1]).all()
    assert list(check_jumps(slam)) == []


def test_what_is_below_the_bar_and_what_one_pair_says_is_not_told() -> None:
    """Half of what is told; a pair whose matches are of something that has another depth in one of its pictures alone;
    a keyframe that one pair joins to the rest.
    """
    assert list(check_jumps(_walk(unit=float(np.exp(MOST_CHANGE / 2))))) == []
    slam, few = _walk(), np.arange(POINTS // 3)
    keyframe = slam.keyframes[AT]
    prior = keyframe.points.prior.copy()
    prior[few] /= 1.3
    other = replace(keyframe, points=replace(keyframe.points, prior=prior))
    keyframes = (*slam.keyframes[:AT], other, *slam.keyframes[AT + 1 :])
    only = lambda m: replace(m, **{field.name: getattr(m, field.name)[few] for field in fields(m)})
    pairs = tuple(replace(p, points=only(p.points)) if p.key == (AT - 1, AT) else p for p in slam.pairs)
    assert list(check_jumps(replace(slam, keyframes=keyframes, pairs=pairs))) == []
    jumped = _walk(unit=FACTOR)
    crossing = [pair for pair in jumped.pairs if pair.first < AT <= pair.second]
    kept = tuple(pair for pair in jumped.pairs if pair not in crossing or pair.key == (AT - 1, AT))
    assert list(check_jumps(replace(jumped, pairs=kept))) == []
