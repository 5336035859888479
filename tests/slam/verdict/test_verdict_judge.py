"""A run judged as a whole: from its state and its corners to reasons."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from changed import changed
from corner_walk import K, walk
from recorded_run import recorded_run
from scipy.spatial.transform import Rotation

from vggtgeo.results.result import Result
from vggtgeo.slam.verdict import judge as judge_module
from vggtgeo.slam.verdict.claim import WINDOW, Claim, linked, thinned, tracks_of_windows, windows
from vggtgeo.slam.verdict.corner_adjustment import Noise, solve, start_of
from vggtgeo.slam.verdict.corner_findings import findings
from vggtgeo.slam.verdict.corner_recorder import CornerRecorder
from vggtgeo.slam.verdict.findings import Finding, Verdict, conclude
from vggtgeo.slam.verdict.judge import check_unit, check_unseen, judge, judge_or_report
from vggtgeo.slam.verdict.thresholds import MAX_REASONS


def _turn(degrees: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return pose


def test_a_run_is_judged_as_a_whole() -> None:
    """A simulated run is good; with its keyframes turned it is not, and JSON keeps the verdict. Oracle: the turn."""
    run = recorded_run()
    recorder = CornerRecorder(run.sequence.camera)
    for frame in run.frames:
        recorder.add(frame)
    assert judge(run.slam, recorder.frames).level == "good"
    assert judge(run.slam, recorder.frames[:-1]).level == "good"
    assert Result.of(run.slam, recorder.frames).verdict.level == "good"
    keyframes = [replace(k, pose=k.pose @ _turn(30.0 * k.number)) for k in run.slam.keyframes]
    wrong = changed(run.slam, "map", keyframes=tuple(keyframes))
    stirred = judge(wrong, recorder.frames)
    assert stirred.level != "good"
    assert judge(wrong, recorder.frames[:-1]).level != "good"
    assert Verdict.from_dict(json.loads(json.dumps(stirred.to_dict())), stirred.metric) == stirred


def test_an_error_in_the_verdict_loses_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is reported, the verdict is not good, and findings about the input stay. Oracle: the planted error."""

    def fails(*_: object) -> list[Finding]:
        raise np.linalg.LinAlgError("Singular matrix")

    slam = recorded_run().slam
    known = Finding("input", "degraded", "two frames were left out")
    assert judge_or_report(slam).level == judge(slam).level == "good"
    monkeypatch.setattr(judge_module, "check_extent", fails)
    verdict = judge_or_report(slam, (), (known,))
    assert verdict.level == "degraded"
    assert any("LinAlgError: Singular matrix" in reason for reason in verdict.reasons)
    assert known.text in verdict.reasons
    monkeypatch.setattr(Claim, "of", fails)
    assert judge_or_report(slam, (), (known,)) == verdict


def test_a_cause_is_one_reason() -> None:
    """Windows with the same fault make one finding that spans them; there are at most `MAX_REASONS`. Oracle: what was
    planted: two windows whose depth grows, with the poses that fit it, and one of displaced poses.
    """
    here, growing = walk(20), walk(20, measured=lambda row, z: z * np.exp(0.5 * row / 19))
    tracks = growing.tracks()
    fitted = solve(tracks, start_of(tracks), Noise(0.3, 0.02)).unknowns.poses
    wrong = growing.explanation(poses=fitted)
    poses = here.claim.poses.copy()
    poses[8:14, 0, 3] += 0.12
    displaced = here.explanation(poses=poses)
    found = findings(here.claim, [wrong, wrong, displaced])
    assert sorted(one.check for one in found) == ["depth", "poses"]
    assert len(found) <= MAX_REASONS
    depth = next(one for one in found if one.check == "depth")
    assert (depth.start, depth.end, depth.scale, depth.level) == (0, 19, True, "degraded")
    assert findings(here.claim, [here.explanation()]) == []


def test_windows_cover_all_linked_frames_and_break_where_nothing_is_common() -> None:
    """Stretches end where frames share no corners; windows overlap and reach both ends. Oracle: by hand."""
    evidence = walk(60).evidence
    evidence[30:] = [replace(frame, ids=frame.ids + 10_000) for frame in evidence[30:]]
    tracked = np.ones(60, bool)
    tracked[10] = False
    stretches = linked(evidence, tracked)
    assert [(rows[0], rows[-1]) for rows in stretches] == [(0, 29), (30, 59)]
    chosen = thinned(evidence, stretches[1])
    assert (chosen[0], chosen[-1]) == (30, 59)
    parts = windows(np.arange(100))
    assert (parts[0][0], parts[-1][-1]) == (0, 99)
    assert all(len(part) == WINDOW for part in parts)
    assert all(second[0] < first[-1] for first, second in pairwise(parts))
    seen = tracks_of_windows(replace(walk(60).claim, tracked=tracked), evidence, (320, 240))
    assert check_unseen(walk(60).claim, seen) == []
    assert [(note.check, note.level) for note in check_unseen(walk(60).claim, seen[:1])] == [("unseen", "good")]


def test_a_wrong_unit_of_depth_is_reported() -> None:
    """Depths ten times too small or five times too large put the scale in doubt; oracle: the factor."""
    here = walk(4)
    for factor, told in ((1.0, False), (0.1, True), (5.0, True)):
        corners = [replace(frame, depth=(factor * frame.depth).astype(np.float32)) for frame in here.evidence]
        found = check_unit(here.claim, corners)
        assert [one.scale for one in found] == [True] * told, factor
    assert check_unit(replace(here.claim, metric=False), here.evidence) == []


def test_what_has_no_consequence_is_a_number() -> None:
    """A slight distortion is significant and moves nothing: no reason, but noted with its size. Oracle: the k1."""

    def seen(row: int, pixels: np.ndarray) -> np.ndarray:
        normalised = (pixels - K[2:]) / K[:2]
        return normalised * (1 - 0.01 * np.sum(normalised**2, 1, keepdims=True)) * K[:2] + K[2:]

    here = walk(20, noise=0.1, seen=seen)
    (one,) = findings(here.claim, [here.explanation()])
    assert (one.check, one.level) == ("distortion", "good")
    assert "-0.01 +- " in one.text
    verdict = conclude([one], range(20), here.claim.times.tolist(), True)
    assert (verdict.level, verdict.reasons, verdict.noted) == ("good", (), (one.text,))
    assert [(part.start, part.end, part.checks) for part in verdict.segments] == [(0, 19, ())]
    assert Verdict.from_dict(json.loads(json.dumps(verdict.to_dict()))) == verdict
