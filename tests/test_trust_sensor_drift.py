"""A lens that zooms while it films, and a depth camera whose unit changes, by keyframes whose depth was measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from recorded_run import recorded_run
from scipy.spatial.transform import Rotation
from vggtgeo.models import pinhole

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import Readout
from vggtgeo.slam.camera.rolling_shutter import image_shift
from vggtgeo.slam.global_map.frame_motions import camera_motions
from vggtgeo.slam.trust.evidence import EvidenceRecorder
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.sensor_drift import (
    MOST_CHANGE,
    WITHIN,
    DepthPair,
    Ratios,
    changes,
    check_sensors,
    compare,
    directed_pairs,
)

K = np.array([500.0, 500.0, 320.0, 240.0])
KEYFRAMES = 20
Curve = Callable[[float], float]
"""A factor by the share of the run that is over."""


def still(share: float) -> float:
    """Nothing changes."""
    return 1.0


def grows(share: float) -> float:
    """By 1.3 in the end."""
    return 1.0 + 0.3 * share


def shrinks(share: float) -> float:
    """By 1.3 in the end."""
    return 1.0 / (1.0 + 0.3 * share)


def there_and_back(share: float) -> float:
    """By 1.3 in the middle."""
    return 1.0 + 0.3 * (1.0 - abs(2.0 * share - 1.0))


def _pair(
    rng: np.random.Generator,
    numbers: tuple[int, int],
    focal: tuple[float, float],
    unit: tuple[float, float],
    noise: float = 0.01,
) -> DepthPair:
    """Two pictures of sixty points 2 to 8 m away: half a pixel of noise, 1 % in depth, every tenth matched wrongly. The
    camera goes 30 cm forward and turns, and its pose is taken 2 cm and half a degree off. focal, unit: factors of each.
    """
    before, depth = rng.uniform((0, 0), (640, 480), (60, 2)), rng.uniform(2.0, 8.0, 60)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix()
    motion[:3, 3] = (*rng.normal(0, 0.1, 2), -0.3)
    first, second = (K * [factor, factor, 1.0, 1.0] for factor in focal)
    points = (pinhole.rays(before, first) * depth[:, None]) @ motion[:3, :3].T + motion[:3, 3]
    after = pinhole.project(points, second) + rng.normal(0, 0.5, (60, 2))
    after[::10] += rng.normal(0, 50, (6, 2))
    wrong = rigid.moved(motion[None], np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 0.005, 3)])[None])[0]
    measured = [unit[0] * depth, unit[1] * points[:, 2]] * (1 + rng.normal(0, noise, (2, 60)))
    return DepthPair(numbers, before, after, measured[0], measured[1], wrong)


def _run(focal: Curve, unit: Curve, seed: int = 0, keyframes: int = KEYFRAMES, noise: float = 0.01) -> list[DepthPair]:
    """Each keyframe with the next two, both ways."""
    rng = np.random.default_rng(seed)
    at = lambda curve, way: (curve(way[0] / (keyframes - 1)), curve(way[1] / (keyframes - 1)))
    ends = [(i, j) for i in range(keyframes) for j in (i + 1, i + 2) if j < keyframes]
    return [_pair(rng, way, at(focal, way), at(unit, way), noise) for pair in ends for way in (pair, pair[::-1])]


def _ratios(pairs: list[DepthPair]) -> tuple[Ratios, Ratios]:
    """Of the focal length, and of the unit of depth."""
    factors, numbers = [compare(pair, K) for pair in pairs], [pair.numbers for pair in pairs]
    of = lambda said: Ratios.of(numbers, said)
    return of([found.focal for found in factors]), of([found.depth for found in factors])


def test_the_factors_between_two_pictures() -> None:
    """Both are found, with standard deviations that hold, though the camera goes forward as well; oracle: the factors,
    and the spread over pairs.
    """
    rng = np.random.default_rng(0)
    zoomed = [compare(_pair(rng, (0, 1), (1.0, 1.1), (1.0, 1.0)), K).focal for _ in range(200)]
    shorter = [compare(_pair(rng, (0, 1), (1.0, 1.0), (1.0, 0.9)), K).depth for _ in range(200)]
    for factors, truth in ((zoomed, 1.1), (shorter, 0.9)):
        value, sigma = np.array(factors).T
        off = (value - np.log(truth)) / sigma
        assert abs(off.mean()) < 0.3
        assert 0.6 < off.std() < 1.5


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("keyframes", [KEYFRAMES, 3 * KEYFRAMES])
@pytest.mark.parametrize("curve", [grows, shrinks, there_and_back])
def test_what_changes_is_found_and_what_stays_is_not(curve: Curve, keyframes: int, seed: int) -> None:
    """A lens, or a unit of depth, that changes slowly by 1.3 is found, by most of that, and where it goes to and fro
    twice; the other one stays, of the depth where the lens does. Oracle: the factor.
    """
    for which, curves in enumerate([(curve, still), (still, curve)]):
        ratios = _ratios(_run(*curves, seed, keyframes))
        found = changes(ratios[which], np.zeros(keyframes), WITHIN)
        assert len(found) == 1 + (curve is there_and_back)
        for first, last, value in found:
            start, end = (np.log(curve(place / (keyframes - 1))) for place in (first, last))
            assert value == pytest.approx(end - start, abs=0.05)
            assert abs(value) > 0.6 * np.log(1.3)
        others = ratios[1].apart_from(found) if which == 0 else ratios[0]
        assert changes(others, np.zeros(keyframes), WITHIN) == []


def test_small_changes_are_below_the_bar() -> None:
    """Half of what is told, over sixty keyframes; oracle: the bar."""
    little: Curve = lambda share: float(np.exp(share * MOST_CHANGE / 2))
    assert [changes(said, np.zeros(60), WITHIN) for said in _ratios(_run(little, little, keyframes=60))] == [[], []]


def test_the_error_of_a_sensor_at_a_distance_is_no_change() -> None:
    """Of 2.5 % a metre, it adds up to a quarter over a walk of 18 m ahead; oracle: the error of
    each depth. Where the camera went ahead by little, the same is a change.
    """
    bent = lambda depth: depth * (1 + 0.025 * depth)
    run = [pair for pair in _run(still, still, keyframes=60) if pair.numbers[0] < pair.numbers[1]]
    ratios = _ratios([replace(pair, depth=bent(pair.depth), depth_after=bent(pair.depth_after)) for pair in run])
    assert [changes(said, 0.3 * np.arange(60), WITHIN) for said in ratios] == [[], []]
    assert any(changes(said, 0.03 * np.arange(60), WITHIN) for said in ratios)


def test_keyframes_of_a_run_agree() -> None:
    """Pairs of a simulated run, whose lens and depth stay; oracle: none, within five standard deviations and 1 %."""
    slam = recorded_run().slam
    pairs = list(directed_pairs(slam, list(slam.map.pairs)))
    assert {pair.numbers for pair in pairs} == {way for pair in slam.map.pairs for way in (pair.key, pair.key[::-1])}
    for pair in pairs:
        found = compare(pair, np.asarray(slam.intrinsics, np.float64))
        for value, sigma in (found.focal, found.depth):
            assert abs(value) < 5 * sigma + 0.01
            assert sigma < 0.05


def test_pictures_of_which_nothing_fits_say_nothing() -> None:
    """Matches that are all wrong have no say, rather than a sure one."""
    pair = _pair(np.random.default_rng(0), (0, 1), (1.0, 1.0), (1.0, 1.0))
    found = compare(replace(pair, after=pair.after + 1000.0), K)
    assert found.focal[1] == found.depth[1] == np.inf
    rng = np.random.default_rng(1)
    for _ in range(50):  # of which some come to no rest
        pair = _pair(rng, (0, 1), (1.0, 1.0), (1.0, 1.0))
        value, sigma = compare(replace(pair, after=pair.after + rng.normal(0, 15, pair.after.shape)), K).focal
        assert abs(value) < 5 * sigma
    without = compare(replace(pair, depth_after=np.full(60, np.nan)), K)
    assert np.isfinite(without.focal[1])
    assert without.depth[1] == np.inf


def test_a_run_is_asked_where_a_sensor_measured_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """The verdict asks, and only there; a simulated run as it was made is told nothing. Oracle: what the check says."""
    run = recorded_run()
    recorder = EvidenceRecorder(run.sequence.camera)
    for frame in run.frames:
        recorder.add(frame)
    said: list[Finding] = [Finding("calibration", "degraded", "a zoom")]
    assert list(check_sensors(run.slam)) == []
    monkeypatch.setattr("vggtgeo.slam.trust.judge.check_sensors", lambda slam: said)
    assert "a zoom" in judge(run.slam, recorder.frames).reasons
    without = [replace(noted, depth_median=float("nan")) for noted in recorder.frames]
    assert "a zoom" not in judge(run.slam, without).reasons


def test_pairs_are_without_the_rolling_shutter_that_was_found() -> None:
    """Oracle: each match of a simulated run, moved by the time of its row."""
    slam = recorded_run().slam
    number = len(slam.keyframes)
    rolled = replace(slam, camera=replace(slam.camera, readout=Readout(0.03, False, 1.0)))
    pairs, still = (list(directed_pairs(state, list(slam.map.pairs))) for state in (slam, rolled))
    motions, camera, size = camera_motions(slam, number), np.asarray(slam.intrinsics), slam.keyframes[0].size
    moved = 0.0
    for pair, found in zip(pairs, still, strict=True):
        motion = motions[pair.numbers[0]]
        shift = image_shift(pair.before[None], 1 / pair.depth[None], motion[None], camera, size, columns=False)[0]
        assert np.allclose(found.before, pair.before - 0.03 * shift)
        assert not np.array_equal(found.after, pair.after)
        moved = max(moved, float(np.abs(found.before - pair.before).max()))
    assert moved > 0.1


def test_depth_that_is_the_same_everywhere_tells_of_no_lens() -> None:
    """Points at one depth, seen by a camera that goes straight ahead: a lens that zooms and a step look alike, and
    the equations have no solution. Oracle: how the points were made; nothing is said, and nothing fails.
    """
    rng = np.random.default_rng(0)
    before = rng.uniform((100, 100), (540, 380), (60, 2))
    pair = replace(_pair(rng, (0, 1), (1.0, 1.0), (1.0, 1.0)), relative=np.eye(4))
    after = (before - K[2:]) * 1.05 + K[2:]
    same = replace(pair, before=before, after=after, depth=np.ones(60), depth_after=np.ones(60))
    found = compare(same, K)
    assert found.focal[1] == found.depth[1] == np.inf
