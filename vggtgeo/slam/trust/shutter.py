"""The rolling shutter that the last adjustment found: did it bend what was matched and tracked before?"""

from __future__ import annotations

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import Finding

MOST_SHIFT = 7.0
"""Pixels by which one match in ten is off, or more."""


def check_shutter(estimate: Estimate) -> list[Finding]:
    """A shutter so slow, for how the camera moves, that frames were tracked by what is not there."""
    readout = estimate.readout
    if readout is None or readout.shift <= MOST_SHIFT:
        return []
    lines = "columns" if readout.columns else "rows"
    text = (
        f"the camera reads its {lines} out one by one, over about {1000 * abs(readout.seconds):.0f} ms (a rolling "
        f"shutter), in which it moves by up to {readout.shift:.0f} px: move slower, or film with a shorter readout"
    )
    return [Finding("rolling shutter", "degraded", text)]
