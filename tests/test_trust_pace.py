"""A slow camera, or one of many frames a second, is judged over more frames.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from trust_checks import found_by_depth
from witness import Walk, walk, with_depth

from vggtgeo.slam.trust.depth_agreement import check_depth, depth_ratios
from vggtgeo.slam.trust.pace import MOST, pace


@pytest.fixture(scope="module")
def slow() -> Walk:
    """Half a centimetre a frame before points 1.5 to 5 m away."""
    return walk(count=300, step=0.005, sway=0.0)


def test_the_pace_is_that_of_the_camera(slow: Walk, healthy: Walk) -> None:
    """Frames that a constant motion takes to 0.04 of the depth, in sixes; oracle: the motion by hand. 1 where the
    camera stands still, where no depth is known, and where it is fast.
    """
    middle = float(np.median([noted.depth_median for noted in slow.evidence]))
    assert pace(slow.estimate, slow.evidence) == int(np.ceil(0.04 * middle / 0.005 / 6))
    assert pace(healthy.estimate, healthy.evidence) == 1
    still = walk(count=60, step=0.0, sway=0.0)
    assert pace(still.estimate, still.evidence) == 1
    blind = [replace(noted, depth_median=float("nan")) for noted in slow.evidence]
    assert pace(slow.estimate, blind) == 1
    crawling = walk(count=60, step=0.0005, sway=0.0)
    assert pace(crawling.estimate, crawling.evidence) == 1
    assert 1 < pace(slow.estimate, slow.evidence) <= MOST


def test_depth_of_another_unit_is_told_of_a_slow_camera(slow: Walk) -> None:
    """Depth a quarter too long: frames beside each other have no corner with parallax, and nothing was told."""
    wrong = with_depth(slow.evidence, lambda noted: 1.25 * noted.depth)
    assert list(check_depth(slow.estimate, depth_ratios(slow.estimate, wrong))) == []
    assert "depth scale" in {finding.check for finding in found_by_depth(slow.estimate, wrong)}
    assert found_by_depth(slow.estimate, slow.evidence) == []
