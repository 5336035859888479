"""A free scale that jumps.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

from trust_checks import found_by_scale
from witness import Walk

from vggtgeo.geometry import rigid


def test_a_scale_that_jumps_is_told(healthy: Walk) -> None:
    """Without depth, the second half of the path twice as large: told around frame 20, and only without a unit."""
    world = rigid.invert(healthy.estimate.poses)
    world[20:, :3, 3] = world[20, :3, 3] + 2.0 * (world[20:, :3, 3] - world[20, :3, 3])
    free = replace(healthy.with_poses(rigid.invert(world)), metric=False)
    found = found_by_scale(free, healthy.evidence)
    assert len(found) == 1
    assert found[0].start <= 20 <= found[0].end
    assert found_by_scale(replace(free, metric=True), healthy.evidence) == []
