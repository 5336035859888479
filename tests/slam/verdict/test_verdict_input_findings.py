"""Frames that were left out of the input."""

from __future__ import annotations

from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.slam.verdict.judge import check_input


def test_frames_left_out_are_told() -> None:
    """A tenth of the frames left out by the reader is told, one of a hundred is not."""
    assert check_input([LeftOutWarning("unreadable"), "something else"], 99) == ()
    assert [f.level for f in check_input([LeftOutWarning("repeated", 30)], 30)] == ["degraded"]
