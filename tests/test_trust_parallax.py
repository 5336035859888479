"""A map without depth that nobody saw from two sides is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_trust_scale_hand_over import _walk

from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.parallax import check_parallax, largest_parallax


@pytest.mark.parametrize(("step", "told"), [(0.1, False), (0.03, False), (0.005, True)])
def test_hardly_any_parallax_is_told(step: float, told: bool) -> None:
    """Points 3 to 5 m away, keyframes three steps apart share them; oracle: the angles of that, 5.7, 1.7 and 0.3
    degrees at most. With depth nothing is said: that gives the places.
    """
    slam = _walk([step] * 6)
    angles = largest_parallax(slam)
    assert len(angles) == 7 * 60
    assert np.rad2deg(angles.max()) == pytest.approx(np.rad2deg(3 * step / 3.0), rel=0.1)
    for texts in ([f.text for f in check_parallax(slam)], list(judge(slam).reasons)):
        assert any("hardly any parallax" in text for text in texts) == told
    assert check_parallax(replace(slam, map=replace(slam.map, metric=True))) == []


def test_a_map_without_matches_has_no_parallax_to_ask_for() -> None:
    """Nothing is said of nothing; a point of unknown depth does not count. Oracle: the counts."""
    slam = _walk([0.1] * 3)
    assert check_parallax(replace(slam, map=replace(slam.map, pairs=()))) == []
    first = slam.keyframes[0]
    blind = replace(first, points=replace(first.points, inverse_depth=np.full(60, np.nan)))
    assert len(largest_parallax(replace(slam, map=replace(slam.map, keyframes=(blind, *slam.keyframes[1:]))))) == 3 * 60
