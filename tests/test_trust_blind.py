"""Steps that no image saw.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from witness import Walk

from vggtgeo.slam.trust.blind import check_blind
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.steps import steps


def test_steps_that_nobody_saw_are_told(healthy: Walk) -> None:
    """No corner lives across frame 20, and its pose has 12 inliers: told; with 100 inliers it is not."""
    cut = [replace(f, ids=f.ids + (10_000 if f.frame >= 20 else 0)) for f in healthy.evidence]
    few = np.where(np.arange(40) == 20, 12, 100)

    def found(inliers: np.ndarray) -> list[Finding]:
        estimate = replace(healthy.estimate, inliers=inliers)
        return check_blind(estimate, cut, steps(estimate, cut))

    assert [(f.start, f.end, f.local) for f in found(few)] == [(19, 20, False)]
    assert found(np.full(40, 100)) == []
    by_surface = replace(healthy.estimate, inliers=few, by_surface=np.arange(40) == 20)
    assert check_blind(by_surface, cut, steps(by_surface, cut)) == [], "picture and surfaces place it without a match"
    elsewhere = replace(by_surface, by_surface=np.arange(40) == 21)
    assert len(check_blind(elsewhere, cut, steps(elsewhere, cut))) == 1
    estimate = replace(healthy.estimate, inliers=few)
    assert check_blind(estimate, healthy.evidence, steps(estimate, healthy.evidence)) == []
