"""Depth images that are frozen, or of another unit.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
from witness import Walk, with_depth

from vggtgeo.slam.trust.depth_images import check_frozen, check_range


def test_a_frozen_depth_image_is_told(healthy: Walk) -> None:
    """The same depth image while the picture moves is told with its frames; the same image too (a still) is not, nor is
    depth that was not used.
    """
    frozen = [replace(f, depth_changed=0.0 if 10 <= f.frame <= 20 else 1.0) for f in healthy.evidence]
    assert [(f.start, f.end) for f in check_frozen(healthy.estimate, frozen, harmless=False)] == [(9, 20)]
    assert [(f.local, f.scale) for f in check_frozen(healthy.estimate, frozen, harmless=True)] == [(True, False)]
    assert check_frozen(replace(healthy.estimate, metric=False), frozen, harmless=False) == []
    still = [replace(healthy.evidence[0], frame=k, depth_changed=0.0) for k in range(20)]
    assert check_frozen(healthy.estimate, still, harmless=False) == []


@pytest.mark.parametrize("factor", [0.001, 0.1, 1.0, 5.0])
def test_a_wrong_unit_of_depth_is_told(healthy: Walk, factor: float) -> None:
    """A world of 3 mm or of 15 m is no room, even where poses and depth agree with each other."""
    found = check_range(healthy.estimate, with_depth(healthy.evidence, lambda f: factor * f.depth))
    assert [f.scale for f in found] == ([] if factor == 1.0 else [True])
