"""Speeds that nobody who carries a camera through a building has.

Walking is 1.5 m/s, running 3 to 4; the clips have medians of 0.2 (redkitchen), 0.6 to 0.9 (HoloLens), at most 2.4 over
`SPAN` seconds. A single wrong pose is a matter of the images (`steps`), so speeds are taken over `SPAN`. Across a cut
of the video, after which the camera was found again by many matches, nobody moved: there is no speed.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import Finding, spans

SPAN = 0.4
"""Seconds."""
MOST_SPEED = 5.0
MOST_TYPICAL_SPEED = 3.0
"""m/s: over `SPAN`, and the median over the run."""


def check_speed(estimate: Estimate, cuts: np.ndarray | None = None) -> list[Finding]:
    """Stretches that are too fast, and a run that is.

    cuts: bool [n - 1], steps over which there is no speed.
    """
    if not estimate.metric or len(estimate) < 3:
        return []
    speed = speeds(estimate, np.zeros(len(estimate) - 1, bool) if cuts is None else cuts)
    typical = float(np.median(speed))
    if typical > MOST_TYPICAL_SPEED:
        text = (
            f"the camera moves at {typical:.1f} m/s: nobody carries one so fast; is the unit of the depth right, and "
            "are there as many frames a second as the times say (`--fps`)?"
        )
        return [Finding("speed", "degraded", text, scale=True)]
    found = []
    for first, last in spans(speed > MOST_SPEED, join=3):
        start, end = int(estimate.frames[first]), int(estimate.frames[min(last + 1, len(estimate) - 1)])
        text = f"frames {start} to {end}: the camera moves at {speed[first : last + 1].max():.0f} m/s"
        found.append(Finding("speed", "degraded", text, start, end))
    return found


def speeds(estimate: Estimate, cuts: np.ndarray) -> np.ndarray:
    """From each frame to the first one at least `SPAN` later (or the last, or the last before a cut), m/s, float64
    [n - 1]; 0 where the cut comes next, and to and from a lost frame, whose pose is only predicted (the first frames of
    a run in a known map stand where that map begins).
    """
    rows = np.arange(len(estimate) - 1)
    later = np.minimum(np.searchsorted(estimate.times, estimate.times[:-1] + SPAN - 1e-9), len(estimate) - 1)
    later = np.maximum(later, rows + 1)
    before_cut = np.append(np.nonzero(cuts)[0], len(estimate) - 1)
    later = np.minimum(later, before_cut[np.searchsorted(before_cut, rows)])
    distance = np.linalg.norm(estimate.centres[later] - estimate.centres[rows], axis=1)
    distance = np.where(estimate.tracked[rows] & estimate.tracked[later], distance, 0.0)
    return np.asarray(distance / np.maximum(estimate.times[later] - estimate.times[rows], min(SPAN, 0.03)))
