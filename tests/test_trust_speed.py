"""Speeds that no camera has.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from witness import Walk

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.blind import cuts
from vggtgeo.slam.trust.speed import check_speed
from vggtgeo.slam.trust.steps import steps


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


def test_nobody_moves_across_a_cut(healthy: Walk) -> None:
    """5 m between two frames that show other things: no speed where both poses rest on many matches; told where one of
    them rests on few, where a corner lives across the leap, and where the camera leaps once more.
    """
    away = rigid.invert(healthy.estimate.poses)
    away[20:, 0, 3] += 5
    leap = replace(healthy.with_poses(rigid.invert(away)), inliers=np.full(40, 100))
    cut = [replace(f, ids=f.ids + (10_000 if f.frame >= 20 else 0)) for f in healthy.evidence]

    def found(estimate, evidence) -> list[tuple[int, int]]:
        across = cuts(estimate, evidence, steps(estimate, evidence))
        return [(f.start, f.end) for f in check_speed(estimate, across)]

    assert np.nonzero(cuts(leap, cut, steps(leap, cut)))[0].tolist() == [19]
    assert found(leap, cut) == []
    few = replace(leap, inliers=np.where(np.arange(40) == 20, 12, 100))
    assert [start <= 19 < end for start, end in found(few, cut)] == [True]
    assert [start <= 19 < end for start, end in found(leap, healthy.evidence)] == [True]
    away[30:, 0, 3] += 5
    twice = replace(leap, poses=rigid.invert(away))
    assert [20 <= start <= 29 < end for start, end in found(twice, cut)] == [True]


def test_nobody_moves_from_where_a_lost_frame_is_said_to_be(healthy: Walk) -> None:
    """The first two frames of a run in a known map stand where that map begins, 5 m away, until the third is found: no
    speed. Told where they were tracked.
    """
    away = rigid.invert(healthy.estimate.poses)
    away[:2, 0, 3] += 5
    leap = healthy.with_poses(rigid.invert(away))
    assert check_speed(replace(leap, tracked=np.arange(40) >= 2)) == []
    assert [(f.start, f.end >= 2) for f in check_speed(leap)] == [(0, True)]
