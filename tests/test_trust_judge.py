"""All checks together: silent on a healthy walk, and a run judged as a whole."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from recorded_run import recorded_run
from scipy.spatial.transform import Rotation
from trust_checks import found_by_camera, found_by_depth, found_by_parts, found_by_scale, found_by_steps
from witness import walk, with_depth

from vggtgeo.results.result import Result
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.trust import judge as judge_module
from vggtgeo.slam.trust.depth_images import check_frozen, check_range
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import EvidenceRecorder, FrameEvidence
from vggtgeo.slam.trust.finding import Finding, Verdict
from vggtgeo.slam.trust.judge import judge, judged_or_told
from vggtgeo.slam.trust.record import check_record
from vggtgeo.slam.trust.speed import check_speed

CHECKS = (found_by_steps, found_by_parts, found_by_depth, found_by_camera, found_by_scale, check_range)


def _all(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    found = [check(estimate, evidence) for check in CHECKS]
    return (
        [f for part in found for f in part]
        + check_frozen(estimate, evidence, harmless=lambda first, last: False)
        + check_record(estimate)
        + check_speed(estimate)
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_walk_is_told_nothing(seed: int) -> None:
    """No check fires on true poses with noise, with depth or without; oracle: the truth, over seeds."""
    here = walk(seed=seed)
    assert _all(here.estimate, here.evidence) == []
    free = replace(here.estimate, metric=False)
    assert _all(free, with_depth(here.evidence, lambda frame: np.full(len(frame.ids), np.nan))) == []


def _turn(degrees: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return pose


def test_a_run_is_judged_as_a_whole() -> None:
    """A simulated run is good; with its poses stirred it is not, and its page and JSON would say so."""
    run = recorded_run()
    recorder = EvidenceRecorder(run.sequence.camera)
    for frame in run.frames:
        recorder.add(frame)
    assert judge(run.slam, recorder.frames).level == "good"
    assert Result.of(run.slam, recorder.frames).verdict.level == "good"
    keyframes = [replace(k, pose=k.pose @ _turn(30.0 * k.number)) for k in run.slam.keyframes]
    stirred = judge(replace(run.slam, map=replace(run.slam.map, keyframes=tuple(keyframes))), recorder.frames)
    assert stirred.level != "good"
    again = Verdict.from_dict(json.loads(json.dumps(stirred.to_dict())), stirred.metric)
    assert again == stirred


def test_matches_are_asked_with_depth_and_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all keyframes, by the bounds of the kind of map. Oracle: a check in its place that says what it was given."""

    def says(keyframes: list[Keyframe], _: np.ndarray, alone: bool, metric: bool) -> list[Finding]:
        return [Finding("matches", "degraded", f"{len(keyframes)} keyframes, {alone=}, {metric=}")]

    slam = recorded_run().slam
    monkeypatch.setattr(judge_module, "check_matches", says)
    for metric in (True, False):
        reasons = judge(replace(slam, map=replace(slam.map, metric=metric))).reasons
        assert f"{len(slam.keyframes)} keyframes, alone=True, {metric=}" in reasons


def test_a_check_that_fails_loses_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its error is told, the verdict is not good, and what was found of the input stays. Oracle: the planted fault."""

    def fails(*_: object) -> list[Finding]:
        raise np.linalg.LinAlgError("Singular matrix")

    slam = recorded_run().slam
    known = Finding("input", "degraded", "two frames were left out")
    assert judged_or_told(slam).level == judge(slam).level == "good"
    monkeypatch.setattr(judge_module, "check_extent", fails)
    verdict = judged_or_told(slam, (), (known,))
    assert verdict.level == "degraded"
    assert any("LinAlgError: Singular matrix" in reason for reason in verdict.reasons)
    assert known.text in verdict.reasons
