"""A path that is no longer than its own error.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from corner_walk import Walk
from reported import pattern

from vggtgeo.geometry import rigid
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty
from vggtgeo.slam.verdict.judge import check_extent, stated_share


def test_a_path_without_depth_and_shorter_than_its_error_is_told(healthy: Walk) -> None:
    """Of free scale, places that are known to two thirds of their spread are told, and those known to a third are not;
    with metres it is no matter of scale. Oracle: the spread of the walk's own path.
    """
    free = replace(healthy.claim, metric=False)
    spread = float(np.sqrt(rigid.centres(free.poses).var(0).sum()))
    sigma = np.where(np.arange(len(free)) % 3, np.nan, spread / 1.5)
    known = lambda places: stated_share(free, PoseUncertainty(free.times, places, np.zeros(len(free))))
    assert [f.check for f in check_extent(free, known(sigma))] == ["extent"]
    assert re.search(pattern("67"), check_extent(free, known(sigma))[0].text)
    assert check_extent(free, known(sigma / 2)) == []
    assert check_extent(free, stated_share(free, None)) == []
    assert check_extent(healthy.claim, known(sigma)) == []
