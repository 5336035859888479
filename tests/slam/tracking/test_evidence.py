"""What speaks for a pose, in words of the evidence."""

from __future__ import annotations

import pytest

from vggtgeo.slam.tracking.evidence import Evidence


@pytest.mark.parametrize(
    ("old", "present", "well"), [(0.51, 0.93, False), (0.85, 0.95, True), (0.5, 0.6, True), (float("nan"), 0.9, True)]
)
def test_an_old_keyframe_shows_a_frame_as_well_as_the_present_one(old: float, present: float, well: bool) -> None:
    """Half the correlation is not as well; nothing to compare is no reason against. Oracle: the definition."""
    assert Evidence(correlation=old).shows_as_well(Evidence(correlation=present)) is well
