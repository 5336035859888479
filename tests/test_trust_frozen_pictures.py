"""Pictures that stay the same: because the camera does, or because the recorder hung."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from witness import Walk

from vggtgeo.slam.trust.frozen_pictures import check_frozen_pictures

FIRST = 15


def _seen(healthy: Walk, rows: list[int]) -> Walk:
    """The walk along these rows, corners to a hundredth of a pixel."""
    rng = np.random.default_rng(1)
    evidence = []
    for row, shown in enumerate(rows):
        pixels = healthy.evidence[shown].pixels
        pixels = (pixels + 0.01 * rng.standard_normal(pixels.shape)).astype(np.float32)
        evidence.append(replace(healthy.evidence[shown], frame=row, pixels=pixels))
    return Walk(healthy.with_poses(healthy.estimate.poses[rows]), evidence)


@pytest.mark.parametrize(("length", "told"), [(2, False), (4, True), (12, True)])
def test_a_picture_that_stays_while_the_camera_goes_on_is_told(healthy: Walk, length: int, told: bool) -> None:
    """The poses stay with the picture, and jump to where the camera is; two pictures are a recorder's that fills its
    rate up. Oracle: the rows whose picture is that of the one before.
    """
    rows = [FIRST if FIRST <= row <= FIRST + length else row for row in range(40)]
    walked = _seen(healthy, rows)
    found = check_frozen_pictures(walked.estimate, walked.evidence)
    assert [(one.start, one.end) for one in found] == ([(FIRST + 1, FIRST + length)] if told else [])


def test_a_camera_that_stands_still_is_no_fault(healthy: Walk) -> None:
    """It goes on with steps like those before; and what stays the same at the end jumps nowhere. Oracle: the walk."""
    stops = [row if row <= FIRST else max(FIRST, row - 12) for row in range(40)]
    ends = [min(row, 30) for row in range(40)]
    for rows in (stops, ends, list(range(40))):
        walked = _seen(healthy, rows)
        assert check_frozen_pictures(walked.estimate, walked.evidence) == []
