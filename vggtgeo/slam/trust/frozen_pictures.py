"""Pictures that stayed the same while the camera went on: a recorder that hung, a stream that stalled.

A camera that stands still goes on as it stops, with steps like those around. Where the picture stood still to `STILL`
pixels, and the first step after that is `MORE` times those around, the camera moved meanwhile, and nobody saw how.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, flow
from vggtgeo.slam.trust.finding import Finding, spans

STILL = 0.1
"""Pixels, the median of the corners: what a codec makes of one picture that is repeated."""
LEAST_FRAMES = 3
"""Pictures in a row like the one before: two are those of a recorder that fills its rate up."""
AROUND = 10
"""Frames on either side whose steps are compared."""
MORE = 3.0
"""Twelve pictures of redkitchen that are the one before them have 12.3 (25 cm, and the run was called good), five of
corridor-office 4.8; where the camera stood still, too, the first step after it has 1.2 to 1.4 (three pieces, two with
depth). `benchmarks/edited_videos.py --changes hangs stands`: what hangs is told, what stands is good, on four clips."""
LEAST_TURN = np.radians(0.2)
"""Of the steps around, what noise turns by."""


def check_frozen_pictures(estimate: Estimate, evidence: Evidence) -> list[Finding]:
    """Frames whose picture stayed while the camera went on: their poses are those of the frame before."""
    still = np.array([False, *(flow(first, second) < STILL for first, second in pairwise(evidence))])
    found = []
    for first, last in spans(still):
        if last - first + 1 >= LEAST_FRAMES and last + 1 < len(estimate) and jump_after(estimate, still, last) > MORE:
            start, end = evidence[first].frame, evidence[last].frame
            text = (
                f"frames {start} to {end}: the picture stays that of frame {evidence[first - 1].frame}, and then "
                "jumps: the recording stood still, the camera did not"
            )
            found.append(Finding("frozen picture", "degraded", text, start, end))
    return found


def jump_after(estimate: Estimate, still: np.ndarray, last: int) -> float:
    """The step from row `last` to the next, in turn and in way, as a multiple of the steps around in which the picture
    moves; 0 where there are none, or it is unknown. still: bool [n], pictures like those before.
    """
    tracked = estimate.tracked[1:] & estimate.tracked[:-1]
    motions = estimate.poses[1:] @ rigid.invert(estimate.poses[:-1])
    turn = np.arccos(np.clip((np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    way = np.linalg.norm(motions[:, :3, 3], axis=1)
    rows = np.flatnonzero(tracked & ~still[1:])
    before, after = rows[rows < last][-AROUND:], rows[rows > last][:AROUND]
    around = np.concatenate([before, after])
    if len(around) < LEAST_FRAMES or not tracked[last]:
        return 0.0
    usual_turn, usual_way = max(np.median(turn[around]), LEAST_TURN), np.median(way[around])
    return float((turn[last] / usual_turn + way[last] / max(usual_way, 1e-12)) / 2)
