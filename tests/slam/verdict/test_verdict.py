"""From findings to a verdict and its segments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from changed import changed

import vggtgeo as vg
from vggtgeo.slam.state import stretches
from vggtgeo.slam.verdict.claim import Claim
from vggtgeo.slam.verdict.findings import Finding, conclude


def test_the_verdict_covers_the_run_without_gaps() -> None:
    """Segments join up, each with the checks that concern it; oracle: findings laid out by hand."""
    found = [
        Finding("a", "degraded", "A", 2, 4),
        Finding("b", "failed", "B", 4, 5),
        Finding("c", "degraded", "C", scale=True),
    ]
    verdict = conclude(found, range(8), [k / 10 for k in range(8)], metric=True)
    assert (verdict.level, verdict.metric, verdict.reasons[0]) == ("failed", False, "B")
    assert [(s.start, s.end, s.level, s.checks) for s in verdict.segments] == [
        (0, 1, "degraded", ("c",)),
        (2, 3, "degraded", ("a", "c")),
        (4, 4, "failed", ("b", "a", "c")),
        (5, 5, "failed", ("b", "c")),
        (6, 7, "degraded", ("c",)),
    ]


def test_stretches_are_runs_of_marked_rows() -> None:
    """Runs of marked rows; oracle: by hand."""
    marked = np.array([0, 1, 1, 0, 1, 0, 0, 0, 1], bool)
    assert stretches(marked) == ((1, 2), (4, 4), (8, 8))
    assert stretches(np.zeros(3, bool)) == ()


def test_a_lost_frame_keeps_its_place_in_the_claim() -> None:
    # Proves that frames without a pose, which the trajectory leaves out, do not shift the others in the verdict,
    # and that they are told. Oracle: the frames' numbers.
    *_, slam = vg.run(vg.simulate("room", 3, size=(160, 120)))
    middle = replace(slam.frames[1], tracked=False)
    slam = changed(slam, "tracker", frames=(slam.frames[0], middle, slam.frames[2]))
    claim = Claim.of(slam)
    assert len(claim.times) == len(claim.poses) == len(claim.frames) == 3
    assert len(vg.frame_trajectory(slam)) == 2
    assert "lost" in str(vg.Result.of(slam).verdict)
