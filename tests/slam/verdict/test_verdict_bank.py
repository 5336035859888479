"""The bank of simulated runs: what it holds, and that recordings with a fault are still recordings."""

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from benchmark_modules import benchmark

import vggtgeo as vg
from vggtgeo.simulation import IDEAL, WORLDS
from vggtgeo.simulation.degradations import Recording


@pytest.fixture(scope="module")
def bank() -> ModuleType:
    return benchmark("verdict_bank")


def test_half_of_the_runs_are_healthy_and_the_halves_share_no_seed(bank: ModuleType) -> None:
    # Proves what the bank says of itself, also of its first part. Oracle: counts.
    cases = bank.cases(420)
    assert len({case.name for case in cases}) == 420
    for part in (cases, cases[:60]):
        assert sum(case.degradation == bank.HEALTHY for case in part) == len(part) // 2
        assert sum(case.half == "set" for case in part) == len(part) // 2
        assert {case.walk.world for case in part} == set(WORLDS)
    assert {case.degradation for case in cases[:60]} == set(bank.FAULTS), "the first part lacks a fault"
    seeds = [{case.walk.seed for case in cases if case.half == half} for half in bank.HALVES]
    assert not seeds[0] & seeds[1]
    assert cases[:60] == bank.cases(60)


def test_a_recording_with_a_fault_is_a_recording(bank: ModuleType) -> None:
    # Proves, for each fault, weak and strong, that frames are in order and have their size and truth, and that the
    # fault changes something. Oracle: the same run without it.
    first = bank.cases(1)[0]
    walk = replace(first.walk, size=(40, 30), frames=12)
    own = vg.simulate("room", 12, 0, walk.size, rate=walk.rate, sensor=IDEAL)
    seen = Recording(list(own.frames()), own.camera, own.ground_truth())
    elsewhere = replace(
        seen, frames=[replace(frame, image=frame.image[::-1].copy(), depth=2 * frame.depth) for frame in seen.frames]
    )
    render = lambda wanted: seen if wanted == walk else elsewhere
    case = replace(first, walk=walk, rgb_only=False)
    healthy = bank.record(case, render)
    for name in bank.FAULTS:
        for severity in (0.4, 1.0) if name != bank.HEALTHY else ():
            changed = bank.record(replace(case, degradation=name, severity=severity), render)
            _check(name, changed)
            assert _differs(healthy, changed), name


def _check(name: str, recording: Recording) -> None:
    count = len(recording.frames)
    times = np.array([frame.timestamp for frame in recording.frames])
    assert [frame.index for frame in recording.frames] == list(range(count)), name
    assert len(recording.truth) == count, name
    assert np.abs(recording.truth.timestamps - times).max() < 0.02, name
    assert (np.diff(times) > 0).all(), name
    for frame in recording.frames:
        assert frame.image.dtype == np.uint8, name
        assert frame.image.shape == (30, 40, 3), name
        assert frame.depth is not None, name
        assert frame.depth.shape == (30, 40), name


def _differs(first: Recording, second: Recording) -> bool:
    if first.camera != second.camera or len(first.frames) != len(second.frames):
        return True
    pairs = list(zip(first.frames, second.frames, strict=True))
    images = any(not np.array_equal(a.image, b.image) for a, b in pairs)
    return images or any(not np.array_equal(a.depth, b.depth, equal_nan=True) for a, b in pairs)
