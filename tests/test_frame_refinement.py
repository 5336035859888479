"""Frames between keyframes, placed against the finished map; oracle: the true motions of a rendered room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recorded_run import RecordedRun, recorded_run
from vggtgeo.models.rigid_motion import exponential

from vggtgeo.geometry import rigid
from vggtgeo.slam.frame_poses import frame_poses
from vggtgeo.slam.frame_refinement import _agree, refine_frames
from vggtgeo.slam.settings import Roles
from vggtgeo.slam.state import Slam

AWAY = np.array([0.006, -0.005, 0.004, 0.002, -0.003, 0.001])
"""Metres and radians."""


@pytest.fixture(scope="module")
def run() -> RecordedRun:
    return recorded_run()


def between(slam: Slam) -> list[int]:
    """Rows of the frames that are no keyframes."""
    frames = {keyframe.frame for keyframe in slam.keyframes}
    return [row for row, record in enumerate(slam.frames) if record.frame not in frames]


def moved(slam: Slam, away: np.ndarray, sigma: float) -> Slam:
    """The state with its frames between keyframes off by `away`, and said to be known to `sigma` metres."""
    rows, frames = between(slam), list(slam.frames)
    for number, row in enumerate(rows):
        record, sign = frames[row], (-1) ** number
        evidence = replace(record.evidence, sigma_translation=sigma, sigma_rotation=sigma / 2)
        frames[row] = replace(record, relative=exponential(sign * away) @ record.relative, evidence=evidence)
    return replace(slam, frames=tuple(frames))


def off(run: RecordedRun, slam: Slam) -> np.ndarray:
    """Metres by which the camera of each frame between keyframes is off, seen from its keyframe."""
    errors = []
    for row in between(slam):
        record = slam.frames[row]
        keyframe = slam.keyframes[record.reference].frame
        true = run.sequence.pose(record.frame) @ rigid.invert(run.sequence.pose(keyframe))
        errors.append(np.linalg.norm(rigid.centre(record.relative) - rigid.centre(true)))
    return np.array(errors)


def test_frames_that_stand_aside_come_back(run: RecordedRun) -> None:
    """Frames 9 mm aside, every second one to the other side, are brought back to less than half of that, and keyframes
    are left alone; oracle: the renderer's poses.
    """
    wrong = moved(run.slam, AWAY, 0.02)
    found = refine_frames(wrong, run.sequence.frames(), run.sequence.camera, Roles())
    before, after = off(run, wrong), off(run, found)
    assert len(before)
    assert before.min() > 0.005
    assert after.max() < 0.5 * before.max(), (before, after)
    keyframes = sorted({*range(len(wrong.frames))} - {*between(wrong)})
    for row in keyframes:
        np.testing.assert_allclose(found.pose(found.frames[row]), wrong.pose(wrong.frames[row]), atol=1e-12)


def test_poses_that_contradict_each_other_are_told_by_what_both_know() -> None:
    """Two poses agree up to the chi-square quantile of 0.9999 of their distance, in the noise of both together; one of
    which nothing is known agrees with any. Oracle: the quantile, 27.86 with six degrees of freedom.
    """
    first, second = np.eye(6) / 0.003**2, np.eye(6) / 0.004**2  # together 5 mm
    for squared, agree in ((27.0, True), (29.0, False)):
        off = np.array([1.0, -1, 0, 0, 1, 0]) / np.sqrt(3) * 0.005 * np.sqrt(squared)
        assert _agree(off, first, second) is agree
        assert _agree(100 * off, np.zeros((6, 6)), second)


def test_frames_that_do_not_come_again_are_carried_along_as_before(run: RecordedRun) -> None:
    """Without frames, or with frames without depth, the path is the one that keyframes carry along; oracle: that path,
    whose frames here share out a change of 10 cm that an adjustment made.
    """
    slam = run.slam
    rows = [row for row, record in enumerate(slam.frames) if record.arrival is not None]
    reference, tracked = slam.frames[rows[0]].arrival
    shifted = replace(slam.frames[rows[0]], arrival=(reference, exponential(np.full(6, 0.05)) @ tracked))
    slam = replace(slam, frames=(*slam.frames[: rows[0]], shifted, *slam.frames[rows[0] + 1 :]))
    frames = [replace(frame, depth=None) for frame in run.sequence.frames()]
    for given in ([], frames):
        found = refine_frames(slam, given, run.sequence.camera, Roles())
        np.testing.assert_allclose(frame_poses(found)[1], frame_poses(slam)[1], atol=1e-9)
