"""Warnings of the readers: frames that never came."""

from __future__ import annotations

from collections.abc import Iterable

from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.slam.trust.finding import Finding

MOST_LEFT_OUT = 0.10
"""Share of the frames; as many as may be lost while the result is called good."""


def check_input(warned: Iterable[Warning | str], frames: int) -> tuple[Finding, ...]:
    """Frames that a reader left out, beside `frames` that it gave."""
    missing = sum(warning.frames for warning in warned if isinstance(warning, LeftOutWarning))
    if missing <= MOST_LEFT_OUT * (missing + frames):
        return ()
    text = f"{missing} of {missing + frames} frames of the input were left out (see the warnings)"
    return (Finding("input", "degraded", text),)
