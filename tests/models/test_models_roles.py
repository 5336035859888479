"""The typed outputs of the roles refuse what no implementation may return."""

import numpy as np
import pytest
from reported import raises
from vggtgeo.models import roles

INDEX = np.arange(3)
PIXELS = np.zeros((3, 2))
ONES = np.ones(3)
MAP = np.ones((4, 5), np.float32)


WRONG = {
    "pixels": lambda: roles.Features(np.zeros((3, 3)), ONES),
    "scores": lambda: roles.Features(PIXELS, np.ones(2)),
    "pixels_j": lambda: roles.PointMatches(INDEX, INDEX, PIXELS, PIXELS * np.nan, ONES),
    "index_i": lambda: roles.PointMatches(INDEX - 1, INDEX, PIXELS, PIXELS, ONES),
    "index_j": lambda: roles.PointMatches(INDEX, INDEX - 2, PIXELS, PIXELS, ONES),
    "confidence": lambda: roles.PointMatches(INDEX, INDEX, PIXELS, PIXELS, 2 * ONES),
    "endpoints": lambda: roles.Segments(np.zeros((3, 4)), ONES),
    "sigma_rel": lambda: roles.DepthEstimate(MAP, MAP, MAP[:2]),
    "pose": lambda: roles.PoseGuess(2 * np.eye(4), np.ones(3, bool), 0.1, roles.GeometryResult.SUCCESS),
    "inliers": lambda: roles.StartGuess(
        np.eye(4), np.ones((3, 3)), np.ones(2, bool), 0.1, roles.GeometryResult.SUCCESS
    ),
    "found": lambda: roles.WindowGuess(np.eye(4)[None], np.ones(4), MAP[None], MAP[None], np.ones(2, bool)),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_output_is_refused_by_name(name: str) -> None:
    # Proves that an array of wrong shape, range or value raises an error that names it. Oracle: the broken argument.
    with raises(f"`{name}`", error=ValueError):
        WRONG[name]()


def test_refined_targets_need_no_key_point() -> None:
    # Proves that index_j = -1 (MASt3R's targets) is accepted and that select keeps rows together. Oracle: indexing.
    matches = roles.PointMatches(INDEX, np.array([-1, 4, -1]), PIXELS + 1.0, PIXELS + 2.0, ONES * 0.5)
    some = matches.select(np.array([True, False, True]))
    assert len(some) == 2
    np.testing.assert_array_equal(some.index_i, [0, 2])
    np.testing.assert_array_equal(some.index_j, [-1, -1])
