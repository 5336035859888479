"""A lens that zooms while it films, without measured depth: by the focal length that each keyframe wants."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_keyframe_depth import SIZE, keyframe
from test_trust_sensor_drift import KEYFRAMES, Curve, K, grows, still
from vggtgeo.models.roles import Features, PointMatches

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import CameraEstimate, Readout
from vggtgeo.slam.camera.rolling_shutter import image_shift
from vggtgeo.slam.global_map.frame_motions import camera_motions
from vggtgeo.slam.sparse_map.covisibility import without_matches
from vggtgeo.slam.sparse_map.keyframe import Slots
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracker import FramePose, Tracker
from vggtgeo.slam.trust import zoom
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.zoom import KNOWN, STRETCH, FocalLengths, check_zoom, focal_lengths

POINTS, REACH = 80, 4


def breathes(share: float) -> float:
    """By 5 % either way, twice."""
    return 1.0 + 0.05 * float(np.sin(4 * np.pi * share))


def _walk(curve: Curve, seed: int = 0, keyframes: int = KEYFRAMES, noise: float = 0.5) -> Slam:
    """A walk past points 3 to 8 m away, half a pixel of noise and every twentieth match wrong, as a run that knows
    nothing of its lens has it: poses 1 cm and a third of a degree off, depths 5 %.
    """
    rng = np.random.default_rng(seed)
    world = rng.uniform((-2, -2, 3), (2, 2, 8), (POINTS, 3))
    shares = np.linspace(0, 1, keyframes)
    poses = np.tile(np.eye(4), (keyframes, 1, 1))
    for number, pose in enumerate(poses):
        way = number / (KEYFRAMES - 1)
        pose[:3, :3] = Rotation.from_rotvec([0.0, 0.1 * np.sin(4 * way), 0.05 * np.sin(way)]).as_matrix()
        pose[:3, 3] = pose[:3, :3] @ (-1.5 * np.sin(way), -0.3 * np.cos(9 * way), -0.8 * np.sin(way))
    wrong = rigid.moved(poses, rng.normal(0, [0.01] * 3 + [0.006] * 3, (keyframes, 6)))
    found, unknown, one = [], np.full(POINTS, np.nan), np.ones(POINTS)
    for number, (share, pose) in enumerate(zip(shares, poses, strict=True)):
        camera = K * [curve(share), curve(share), 1.0, 1.0]
        pixels = rigid.project(world, pose, camera) + rng.normal(0, noise, (POINTS, 2))
        inverse = np.exp(rng.normal(0, 0.05, POINTS)) / (world @ pose[2, :3] + pose[2, 3])
        slots = Slots(pixels, inverse, unknown, unknown, one, one)
        found.append(replace(keyframe(number, np.ones(SIZE), slots), pose=wrong[number]))
    pairs, rows = [], np.arange(POINTS)
    for first in range(keyframes):
        for second in range(first + 1, min(first + REACH, keyframes)):
            after = found[second].points.pixels + np.where(rng.random((POINTS, 1)) < 0.05, rng.normal(0, 60, 2), 0.0)
            points = PointMatches(rows, rows, found[first].points.pixels, after, one)
            pairs.append(replace(without_matches(first, second), points=points))
    found = [replace(k, features=Features(k.points.pixels, one)) for k in found]
    records = [FramePose(k.frame, k.timestamp, k.number, np.eye(4), True, POINTS) for k in found]
    return Slam(
        map=Map(metric=False, keyframes=tuple(found), pairs=tuple(pairs)),
        camera=CameraEstimate(intrinsics=K, given=K, sigma=np.ones(4)),
        tracker=Tracker(frames=tuple(records)),
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("curve", [still, grows, breathes])
def test_the_focal_length_of_each_keyframe(curve: Curve, seed: int) -> None:
    """From poses and depths that are off; oracle: the curve, but for a factor on all; and the stated deviations."""
    lenses = focal_lengths(_walk(curve, seed), np.arange(KEYFRAMES))
    assert lenses is not None
    truth = np.log([curve(share) for share in np.linspace(0, 1, KEYFRAMES)])
    off = (lenses.value - lenses.value.mean()) - (truth - truth.mean())
    centred = np.eye(KEYFRAMES) - 1 / KEYFRAMES
    sigma = np.sqrt(np.diag(centred @ lenses.covariance @ centred))
    assert np.abs(off).max() < 0.015
    assert np.abs(off / sigma).max() < 4, "deviations count for matches that share errors: these do not"
    assert sigma.max() < KNOWN


@pytest.mark.parametrize(("curve", "percent"), [(grows, (24, 36)), (breathes, (9, 13)), (still, None)])
def test_a_zoom_is_told(curve: Curve, percent: tuple[int, int] | None) -> None:
    """With its size, and where; a lens that stays is told nothing. Oracle: the curve."""
    slam = _walk(curve)
    told = [reason for reason in judge(slam).reasons if "the lens zooms" in reason]
    assert len(told) == (percent is not None)
    if percent is None:
        return
    size = float(told[0].split("about ")[1].split(" %")[0])
    assert percent[0] <= size <= percent[1]
    assert check_zoom(replace(slam, map=replace(slam.map, metric=True))) == [], "measured depth is asked otherwise"


def test_noise_is_no_zoom() -> None:
    """Matches of three pixels of noise, a scene far off: nothing is told that is not sure."""
    for seed in range(4):
        assert check_zoom(_walk(still, seed, noise=3.0)) == []


def test_a_difference_must_be_sure_and_known() -> None:
    """Oracle: by hand, from values and covariances."""
    value = np.array([0.0, 0.0, 0.0, 0.1, 0.1, 0.3])
    variance = [1e-4] * 5 + [KNOWN**2 * 1.1]
    assert FocalLengths(value, np.diag(variance)).largest_change() == (pytest.approx(0.1), 0, 3), "0.3 is not known"
    assert FocalLengths(value, 2.3 * np.diag(variance)).largest_change() == (0.0, 0, 0), "4.7 standard deviations"
    shared = 3.9e-4 * np.ones((6, 6)) + 1e-6 * np.eye(6)
    change = FocalLengths(value, shared).largest_change()[0]
    assert change == pytest.approx(0.2), "what all share is no doubt of a difference; 0.2: the median of the last two"
    assert FocalLengths(value, np.eye(6)).largest_change() == (0.0, 0, 0)


def test_one_keyframe_is_no_zoom() -> None:
    """Bad matches of one keyframe; oracle: its neighbours."""
    value = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])
    assert FocalLengths(value, 1e-6 * np.eye(6)).largest_change()[0] == 0.0


def test_few_keyframes_or_matches_say_nothing() -> None:
    """Three keyframes; no match; none of a known depth."""
    slam = _walk(grows)
    assert check_zoom(replace(slam, map=replace(slam.map, keyframes=slam.keyframes[:3]))) == []
    assert focal_lengths(replace(slam, map=replace(slam.map, pairs=())), np.arange(KEYFRAMES)) is None
    blind = [replace(k, points=replace(k.points, inverse_depth=np.full(POINTS, np.nan))) for k in slam.keyframes]
    assert focal_lengths(replace(slam, map=replace(slam.map, keyframes=tuple(blind))), np.arange(KEYFRAMES)) is None


@pytest.mark.long
def test_every_keyframe_is_in_a_stretch() -> None:
    """A zoom in a long run is told where it is, once, and keyframes of a known map are not asked; oracle: counting."""
    late = lambda share: 1.0 if share < 0.8 else 1.15
    slam = _walk(late, keyframes=3 * STRETCH)
    parts = list(zoom._stretches(slam))
    assert set(np.concatenate(parts)) == set(range(3 * STRETCH))
    assert all(len(part) == STRETCH for part in parts)
    assert all(len(np.intersect1d(one, two)) >= STRETCH // 2 for one, two in pairwise(parts))
    (finding,) = check_zoom(slam)
    assert finding.start is not None
    assert finding.end is not None
    assert finding.start < round(0.8 * 3 * STRETCH) <= finding.end
    known = [replace(k, recorded=0.0) if k.number >= 0.75 * 3 * STRETCH else k for k in slam.keyframes]
    assert check_zoom(replace(slam, map=replace(slam.map, keyframes=tuple(known)))) == []


def test_matches_are_without_the_rolling_shutter_that_was_found() -> None:
    """Oracle: each key point, moved by the time of its row."""
    slam, every = _walk(still), np.arange(KEYFRAMES)
    states = slam, replace(slam, camera=replace(slam.camera, readout=Readout(0.3, False, 1.0)))
    plain, rolled = (zoom.matches_among(state, every) for state in states)
    assert plain is not None
    assert rolled is not None
    motions, size = camera_motions(slam, KEYFRAMES), slam.keyframes[0].size
    for host in (0, 7):
        own = plain.host == host
        inverse = np.exp(plain.depth[plain.point[own]])
        shift = image_shift(plain.before[own][None], inverse[None], motions[host][None], K, size, columns=False)[0]
        assert np.allclose(rolled.before[own], plain.before[own] - 0.3 * shift)
        assert np.abs(shift).max() > 1
    assert not np.allclose(rolled.after, plain.after)
    assert np.array_equal(plain.point, rolled.point)


def test_derivatives() -> None:
    """Oracle: central differences."""
    slam = _walk(grows)
    seen = zoom.matches_among(slam, np.arange(KEYFRAMES))
    assert seen is not None
    rng = np.random.default_rng(0)
    poses = np.array([k.pose for k in slam.keyframes])
    at = zoom.Unknowns(poses, rng.normal(0, 0.1, KEYFRAMES), seen.depth)
    _, by_frames, by_depth = zoom.derivatives(seen, at)
    step = rng.normal(0, 1e-6, (KEYFRAMES, 7))
    deeper = rng.normal(0, 1e-6, len(seen.depth))
    beside = [
        zoom.Unknowns(rigid.moved(poses, sign * step[:, :6]), at.focal + sign * step[:, 6], at.depth + sign * deeper)
        for sign in (1, -1)
    ]
    ahead, behind = (zoom.derivatives(seen, unknowns)[0] for unknowns in beside)
    both = np.concatenate([step[seen.host], step[seen.target]], 1)
    expected = np.einsum("mij,mj->mi", by_frames, both) + by_depth * deeper[seen.point, None]
    assert np.allclose((ahead - behind) / 2, expected, atol=1e-8)
    assert np.abs(expected).max() > 1e-4
