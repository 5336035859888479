"""What the tracker itself says of its run: whether it ever began, how many frames it lost, how many parts the map has.

A lost stretch of `T` seconds is bridged by assuming a smooth motion. A hand-held camera's acceleration has a standard
deviation of about `ACCELERATION` (the clips: 0.5 to 1.5 m/s^2), so the middle of a bridge is off by `a T^2 / 8`, the
end of a run that is never found again by `a T^2 / 2`. The RMS over all frames says what this does to the ATE.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import MOST_NAMED, Finding, spans

ACCELERATION = 1.0
"""m/s^2."""
MOST_BRIDGED = 0.04
"""Metres, RMS over all frames, that bridges may cost."""
MOST_LOST = 0.10
LEAST_TRACKED = 0.5
"""Share of frames below which the run is not to be used."""


def check_record(estimate: Estimate) -> list[Finding]:
    """Lost frames, new origins, and a map that never was."""
    if not len(estimate):
        return []
    share = float(np.mean(estimate.tracked))
    if not estimate.started or (len(estimate) > 2 and np.count_nonzero(estimate.tracked) <= 1):
        return [Finding("start", "failed", _never_began(estimate))]
    found = []
    if len(estimate) == 1 and not estimate.in_known_map:
        text = "the run is of one frame: there is nothing that its pose and its map could be checked by"
        found.append(Finding("start", "degraded", text))
    stretches = spans(~estimate.tracked)
    serious = 1 - share > MOST_LOST or bridging_error(estimate) > MOST_BRIDGED
    for first, last in stretches:
        start, end = int(estimate.frames[first]), int(estimate.frames[last])
        text = f"frames {start} to {end} were lost; they have no pose"
        text = text if end > start else f"frame {start} was lost; it has no pose"
        found.append(Finding("lost", "degraded", text, start, end, local=not serious or len(stretches) > MOST_NAMED))
    if serious and len(stretches) > MOST_NAMED:
        lost, count, longest = len(estimate) - np.count_nonzero(estimate.tracked), len(stretches), _longest(found)
        text = (
            f"{lost} of {len(estimate)} frames were lost, {count} times, longest from frame {longest.start} to "
            f"{longest.end}; they have no pose"
        )
        found.append(replace(longest, text=text, local=False))
    if share < LEAST_TRACKED:
        found.append(Finding("lost", "failed", f"only {100 * share:.0f} % of the frames were tracked"))
    if estimate.pieces > 1:
        text = (
            f"the map is in {estimate.pieces} parts that nothing ties to each other; trajectory.txt and map.ply hold "
            "the one of most frames, trajectory-2.txt the next"
        )
        found.append(Finding("parts", "degraded", text))
    return found


def _longest(lost: list[Finding]) -> Finding:
    return max(lost, key=lambda finding: (finding.end or 0) - (finding.start or 0))


def _never_began(estimate: Estimate) -> str:
    if not estimate.in_known_map:
        return "no map was ever started: there was not enough parallax, or nothing to see; the poses mean nothing"
    found, count = np.count_nonzero(estimate.tracked), len(estimate)
    return (
        f"{found or 'none'} of the {count} frames was found in the known map: they show another place, or the same one "
        "from elsewhere or in another light; there is no path to use"
    )


def bridging_error(estimate: Estimate) -> float:
    """Metres, RMS over all frames, that the lost ones may be off."""
    squares = 0.0
    for first, last in spans(~estimate.tracked):
        before, after = max(first - 1, 0), min(last + 1, len(estimate) - 1)
        seconds = float(estimate.times[after] - estimate.times[before])
        open_end = first == 0 or last == len(estimate) - 1
        error = ACCELERATION * seconds**2 / (2 if open_end else 8)
        squares += (last - first + 1) * error**2 / 2
    return float(np.sqrt(squares / max(len(estimate), 1)))
