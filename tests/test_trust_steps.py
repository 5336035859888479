"""The steps of the poses against what the images say of them: a jump, one wrong pose, poses that mean nothing.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from trust_checks import found_by_steps
from witness import Walk

from vggtgeo.slam.trust.finding import conclude
from vggtgeo.slam.trust.steps import breaks, check_steps, steps


@pytest.mark.parametrize("metric", [True, False])
def test_a_jump_of_the_poses_is_found_where_it_is(healthy: Walk, metric: bool) -> None:
    """All poses from frame 20 on turned by 6 degrees and shifted: told at frame 19, and nowhere else."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 6, degrees=True).as_matrix()
    turn[:3, 3] = 0.2
    poses = healthy.estimate.poses.copy()
    poses[20:] = turn @ poses[20:]
    found = found_by_steps(replace(healthy.with_poses(poses), metric=metric), healthy.evidence)
    assert [(f.level, f.start, f.end, f.local) for f in found] == [("degraded", 19, 20, False)]


def test_one_wrong_pose_marks_its_frame_and_not_the_run(healthy: Walk) -> None:
    """A pose that is off by 17 cm leaves the verdict good, and its segment degraded; a metre, or many, do not."""
    poses = healthy.estimate.poses.copy()
    poses[20, :3, 3] += 0.1
    estimate = healthy.with_poses(poses)
    found = found_by_steps(estimate, healthy.evidence)
    verdict = conclude(found, estimate.frames.tolist(), estimate.times.tolist(), metric=True)
    assert verdict.level == "good"
    assert [(s.start, s.end, s.level) for s in verdict.segments] == [
        (0, 18, "good"),
        (19, 21, "degraded"),
        (22, 39, "good"),
    ]
    poses[20, :3, 3] += 0.6
    assert [f.local for f in found_by_steps(healthy.with_poses(poses), healthy.evidence)] == [False]
    poses[20, :3, 3] -= 0.6
    poses[5:35:6, :3, 3] += 0.1
    assert any(not f.local for f in found_by_steps(healthy.with_poses(poses), healthy.evidence))


def test_poses_that_mean_nothing_fail(healthy: Walk) -> None:
    """Poses of another walk are contradicted in most steps: failed."""
    other = np.random.default_rng(3).permutation(len(healthy.evidence))
    found = found_by_steps(healthy.with_poses(healthy.estimate.poses[other]), healthy.evidence)
    assert "failed" in {f.level for f in found}


@pytest.mark.parametrize(("share", "told"), [(0.5, True), (0.32, False)])
def test_poses_that_half_of_the_corners_contradict_again_and_again(healthy: Walk, share: float, told: bool) -> None:
    """Half of the corners go another way for 14 frames: too few to contradict one step, and told of all together; of a
    third nothing is told. Oracle: the frames that they were moved in.
    """
    others = lambda frame: np.random.default_rng(5).random(100_000)[frame.ids] < share
    aside = lambda row: np.float32(12.0 * np.clip(row - 12, 0, 14))
    moved = [
        replace(frame, pixels=frame.pixels + aside(row) * others(frame)[:, None].astype(np.float32))
        for row, frame in enumerate(healthy.evidence)
    ]
    taken = steps(healthy.estimate, moved)
    assert not any(step.contradicted for step in taken), "each by itself is none"
    found = check_steps(healthy.estimate, taken, breaks(healthy.estimate, moved, taken))
    assert bool(found) == told
    if told:
        assert {finding.level for finding in found} == {"degraded"}
        assert 10 <= min(finding.start or 0 for finding in found) <= 14
        assert 24 <= max(finding.end or 0 for finding in found) <= 28
        assert not any(finding.local for finding in found)
