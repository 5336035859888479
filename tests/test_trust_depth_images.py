"""Depth images that are frozen, or of another unit.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from witness import Walk, with_depth

from vggtgeo.slam.trust.depth_images import check_frozen, check_range


def test_a_frozen_depth_image_is_told(healthy: Walk) -> None:
    """The same depth image while the picture moves is told with its frames; the same image too (a still) is not, nor is
    depth that was not used.
    """
    never, always_so = (lambda first, last, answer=answer: answer for answer in (False, True))
    frozen = [replace(f, depth_changed=0.0 if 10 <= f.frame <= 20 else 1.0) for f in healthy.evidence]
    assert [(f.start, f.end) for f in check_frozen(healthy.estimate, frozen, harmless=never)] == [(9, 20)]
    assert [(f.local, f.scale) for f in check_frozen(healthy.estimate, frozen, harmless=always_so)] == [(True, False)]
    asked = []
    check_frozen(healthy.estimate, frozen, harmless=lambda first, last: bool(asked.append((first, last))))
    assert asked == [(10, 20)], "of these frames alone"
    assert check_frozen(replace(healthy.estimate, metric=False), frozen, harmless=never) == []
    always = [replace(f, depth_changed=0.0) for f in healthy.evidence]
    told = check_frozen(healthy.estimate, always, harmless=always_so)
    assert [(f.local, f.scale) for f in told] == [(False, True)], "poses that such depth made agree with it"
    still = [replace(healthy.evidence[0], frame=k, depth_changed=0.0) for k in range(20)]
    assert check_frozen(healthy.estimate, still, harmless=never) == []


@pytest.mark.parametrize("factor", [0.001, 0.1, 1.0, 5.0])
def test_a_wrong_unit_of_depth_is_told(healthy: Walk, factor: float) -> None:
    """A world of 3 mm or of 15 m is no room, even where poses and depth agree with each other."""
    found = check_range(healthy.estimate, with_depth(healthy.evidence, lambda f: factor * f.depth))
    assert [f.scale for f in found] == ([] if factor == 1.0 else [True])


def test_a_room_that_ends_at_arms_length_is_told(healthy: Walk) -> None:
    """Depth of a fifth of its length whose median is no smaller than a desk's is told by how near the farthest of it
    is; a desk of that median before a room is told nothing.
    """
    small = with_depth(healthy.evidence, lambda f: np.clip(0.2 * f.depth, 0.55, 0.9))
    assert [f.scale for f in check_range(healthy.estimate, small)] == [True]
    assert "19 in 20 are within 0.9 m" in check_range(healthy.estimate, small)[0].text
    desk = with_depth(healthy.evidence, lambda f: np.where(np.arange(len(f.depth)) % 12 == 0, 2.0, 0.6))
    assert check_range(healthy.estimate, desk) == []
    far = with_depth(healthy.evidence, lambda f: 300 * f.depth)
    free = replace(healthy.estimate, metric=False)
    assert "it was not used, and the scale stays free" in check_range(free, far)[0].text
    assert check_range(free, healthy.evidence) == []


def test_holes_are_far_where_a_sensor_ends(healthy: Walk) -> None:
    """Of a wide view from near a table, a sensor that ends early leaves the table; that is no wrong unit. Without the
    holes as many depths that near are told.
    """
    order = lambda f: np.arange(len(f.depth))
    near = lambda f: np.where(order(f) % 20 == 0, 0.18, np.where(order(f) % 3 == 0, 1.5, np.nan))
    cut = with_depth(healthy.evidence, near)
    cut = [replace(frame, depth_median=1.5) for frame in cut]
    blank = [replace(frame, depth=np.full_like(frame.depth, np.nan)) for frame in cut]  # every second image has depth
    mixed = [a if number % 2 else b for number, (a, b) in enumerate(zip(cut, blank, strict=True))]
    assert check_range(healthy.estimate, mixed) == []
    filled = with_depth(healthy.evidence, lambda f: np.where(order(f) % 6 == 0, 0.18, 1.5))
    assert "a tenth of the corners is within 0.18 m" in check_range(healthy.estimate, filled)[0].text
