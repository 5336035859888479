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
from vggtgeo.slam.rolling_shutter import camera_motions, image_shift
from vggtgeo.slam.state import Readout
from vggtgeo.slam.trust.evidence import EvidenceRecorder
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.sensor_drift import MOST_ZOOM, Change, DepthPair, change, compare, depth_pairs, stretches

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


def _changes(pairs: list[DepthPair]) -> tuple[Change, Change]:
    numbers = np.array([pair.numbers for pair in pairs], np.float64)
    factors = [compare(pair, K) for pair in pairs]
    lens, unit = change(numbers, [f.focal for f in factors]), change(numbers, [f.depth for f in factors])
    assert lens is not None
    assert unit is not None
    return lens, unit


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
@pytest.mark.parametrize("curve", [grows, shrinks, there_and_back])
def test_what_changes_is_found_and_what_stays_is_not(curve: Curve, seed: int) -> None:
    """A lens, or a unit of depth, that changes by 1.3 is found; the other one stays. Oracle: the factor."""
    zoom, unit = _changes(_run(curve, still, seed))
    assert abs(zoom.value) == pytest.approx(np.log(1.3), abs=0.05)
    assert zoom.is_sure
    zoom, unit = _changes(_run(still, curve, seed))
    assert abs(unit.value) == pytest.approx(np.log(1.3), abs=0.05)
    assert unit.is_sure
    assert abs(zoom.value) < MOST_ZOOM / 2


def test_keyframes_of_a_run_agree() -> None:
    """Pairs of a simulated run, whose lens and depth stay; oracle: none, within five standard deviations and 1 %."""
    slam = recorded_run().slam
    pairs = list(depth_pairs(slam, range(len(slam.keyframes))))
    assert {pair.numbers for pair in pairs} == {way for pair in slam.pairs for way in (pair.key, pair.key[::-1])}
    assert [pair.numbers for pair in depth_pairs(slam, range(1, 3))] == [(1, 2), (2, 1)]
    assert list(depth_pairs(slam, range(2, 3))) == []
    for pair in pairs:
        found = compare(pair, np.asarray(slam.intrinsics, np.float64))
        for value, sigma in (found.focal, found.depth):
            assert abs(value) < 5 * sigma + 0.01
            assert sigma < 0.05


def test_every_keyframe_is_in_one_stretch() -> None:
    """Stretches of about a hundred, in order; oracle: counting."""
    for count in (1, 3, 99, 149, 151, 1000, 1234):
        parts = stretches(count)
        assert [number for part in parts for number in part] == list(range(count))
        assert all(len(part) <= 150 for part in parts)
    assert stretches(0) == []
    assert len(stretches(1234)) == 12


def test_few_keyframes_say_nothing() -> None:
    """Three keyframes leave no error to measure by."""
    numbers = np.array([[0, 1], [1, 0], [1, 2], [2, 1], [0, 2]], np.float64)
    assert change(numbers, [(0.1, 0.01)] * 5) is None
    assert change(np.zeros((0, 2)), []) is None


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


@pytest.mark.parametrize(("curves", "text"), [((grows, still), "the lens zooms"), ((still, grows), "the unit of")])
def test_a_run_whose_sensors_change_is_told(
    curves: tuple[Curve, Curve], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The verdict tells it, where a sensor measured depth; oracle: the factor that the pairs were made with. The run as
    it was made is told nothing.
    """
    run = recorded_run()
    recorder = EvidenceRecorder(run.sequence.camera)
    for frame in run.frames:
        recorder.add(frame)
    slam = replace(run.slam, intrinsics=K)
    drift = "vggtgeo.slam.trust.sensor_drift.depth_pairs"
    told = lambda evidence: [reason for reason in judge(slam, evidence).reasons if text in reason]
    assert told(recorder.frames) == []
    monkeypatch.setattr(drift, lambda slam, stretch: _run(*curves))
    (reason,) = told(recorder.frames)
    assert 25 <= float(reason.split("about ")[1].split(" %")[0]) <= 35
    assert told([replace(noted, depth_median=float("nan")) for noted in recorder.frames]) == []
    monkeypatch.setattr(drift, lambda slam, stretch: _run(*curves, noise=0.1))
    assert told(recorder.frames) == [], "steps forward past depth that is noise look like a zoom"


def test_pairs_are_without_the_rolling_shutter_that_was_found() -> None:
    """Oracle: each match of a simulated run, moved by the time of its row."""
    slam = recorded_run().slam
    number = len(slam.keyframes)
    rolled = replace(slam, readout=Readout(0.03, False, 1.0))
    pairs, still = (list(depth_pairs(state, range(number))) for state in (slam, rolled))
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
