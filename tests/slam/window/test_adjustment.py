"""Which line samples take part in an adjustment, and what scales the depth prior."""

from dataclasses import replace

import numpy as np
from reported import raises

from vggtgeo.slam.settings.groups import DepthSettings, WeightSettings
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.window.adjustment import depth_trust, supported

INTRINSICS = np.array([300.0, 300.0, 160.0, 120.0])
# Along the optical axis' right: pixels (160 + 30 k, 120) for points (0.1 k * 3, 0, 3).
POINTS = np.array([[0.3 * k, 0.0, 3.0] for k in range(-4, 5)])
SEGMENT = np.array([[130.0, 120.0], [220.0, 120.0]])


def support(points: np.ndarray, pose: np.ndarray | None = None, segment: np.ndarray = SEGMENT) -> list[bool]:
    ends = np.tile(segment, (len(points), 1, 1))
    pose = np.eye(4) if pose is None else pose
    return supported(points, pose, ends, INTRINSICS).tolist()


def test_a_segment_speaks_for_its_own_length() -> None:
    # Proves that samples beside the segment count and those beyond its ends do not. Oracle: pixels by hand; the
    # answer does not depend on the order of the ends.
    expected = [130 - 10 < 160 + 30 * k < 220 + 10 for k in range(-4, 5)]
    assert support(POINTS) == expected
    assert support(POINTS, segment=SEGMENT[::-1]) == expected


def test_a_sample_far_from_the_line_does_not_count() -> None:
    # Proves the gate across the line. Oracle: 0.11 m at 3 m are 11 px, 0.13 m are 13 px.
    points = np.array([[0.0, 0.11, 3.0], [0.0, 0.13, 3.0], [0.0, -0.11, 3.0]])
    assert support(points) == [True, False, True]


def test_what_is_behind_the_camera_does_not_count() -> None:
    # Proves that the near end of a long edge drops out in a turn, where its mirror image would fall on the segment.
    behind = -POINTS[3:6]
    assert support(behind) == [False] * 3
    turned = np.eye(4)
    turned[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    inside = (turned[:3, :3].T @ np.array([[0.1], [0.0], [3.0]])).T
    assert support(inside, turned) == [True]


def test_the_depth_prior_follows_the_chosen_confidence() -> None:
    # Proves what scales the prior in each setting. Oracle: the numbers given.
    own, saliency = np.array([0.2, 0.9]), np.array([0.7, 0.1])
    expected = {"own": own, "saliency": saliency, "complement": 1 - saliency}
    for name, values in expected.items():
        settings = SlamSettings(depth_terms=DepthSettings(depth_trust=name))
        np.testing.assert_array_equal(depth_trust(own, saliency, settings), values)
        without = replace(settings, weights=WeightSettings(confidence="none"))
        np.testing.assert_array_equal(depth_trust(own, saliency, without), 1.0)
    with raises("depth_trust", "omega"):
        DepthSettings(depth_trust="omega")
