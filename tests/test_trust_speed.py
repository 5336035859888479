"""Speeds that no camera has.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from witness import Walk

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.speed import check_speed


def test_speeds_that_nobody_has_are_told(healthy: Walk) -> None:
    """A world five times too large moves at 3 m/s and more; a leap of 5 m is told with its frames."""
    assert check_speed(healthy.estimate) == []
    large = rigid.invert(healthy.estimate.poses)
    large[:, :3, 3] *= 6
    assert [f.scale for f in check_speed(healthy.with_poses(rigid.invert(large)))] == [True]
    leap = rigid.invert(healthy.estimate.poses)
    leap[20:, 0, 3] += 5
    found = check_speed(healthy.with_poses(rigid.invert(leap)))
    assert [(f.start <= 20 <= f.end, f.scale) for f in found] == [(True, False)]
