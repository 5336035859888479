"""Steps that nobody saw: no corner could be followed across, and the tracker had few matches itself.

A fast turn, blur or a white wall leave fewer than `LEAST_CORNERS` corners between two frames and those beside them. A
pose that was tracked with many inliers stands all the same. One with fewer than `LEAST_INLIERS` does not: wrong matches
agree with a pose by chance, and so a wrong pose has been accepted with 12 inliers of 51. No pose is in doubt that
picture and surfaces give without any match: in building-walk, blurred by 31 px, six frames have none, a correlation of
0.42 to 0.53 and 99 % of their surfaces in place, and the step to each is right to 9 mm.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, common
from vggtgeo.slam.trust.finding import Finding, spans
from vggtgeo.slam.trust.steps import LEAST_CORNERS, MOST_DISPLACED, Step

LEAST_INLIERS = 20
MANY = 50
"""Corners of an image that shows something, and inliers of a pose that chance does not give: as many as let a frame be
tracked by one keyframe."""


def cuts(estimate: Estimate, evidence: Evidence, taken: list[Step]) -> np.ndarray:
    """Steps between two frames that show much and nothing in common, the second of which was placed by many matches:
    the video was cut, and the camera found again. bool [n - 1].
    """
    shown = np.array([len(noted.pixels) >= MANY for noted in evidence], bool)
    placed = estimate.tracked & (estimate.inliers >= MANY)
    found = np.array([len(step.agrees) < LEAST_CORNERS for step in taken], bool)
    found &= shown[:-1] & shown[1:] & placed[:-1] & placed[1:]
    for row in np.nonzero(found)[0]:
        found[row] = not seen_around(evidence, int(row))
    return found


def check_blind(estimate: Estimate, evidence: Evidence, taken: list[Step]) -> list[Finding]:
    """Unseen steps that, were they wrong, would displace more than a small part of the run."""
    few = np.array([len(step.agrees) < LEAST_CORNERS for step in taken], bool)
    weak = (estimate.inliers[1:] < LEAST_INLIERS) & estimate.tracked[1:] & estimate.tracked[:-1]
    if estimate.by_surface is not None:
        weak &= ~estimate.by_surface[1:]
    unseen = few & weak[: len(taken)]
    for row in np.nonzero(unseen)[0]:
        unseen[row] = not seen_around(evidence, int(row))
    found = []
    for first, last in spans(unseen, join=2):
        smaller = min(first + 1, len(estimate) - last - 1) / len(estimate)
        start, end = int(estimate.frames[first]), int(estimate.frames[last + 1])
        text = (
            f"frames {start} to {end}: nothing can be followed through the images, and the poses rest on fewer than "
            f"{LEAST_INLIERS} matches"
        )
        found.append(Finding("blind", "degraded", text, start, end, local=smaller <= MOST_DISPLACED))
    return found


def seen_around(evidence: Evidence, row: int) -> bool:
    """Whether corners live from some frame up to `row` to some frame after it."""
    before, after = range(max(row - 2, 0), row + 1), range(row + 1, min(row + 4, len(evidence)))
    return any(len(common(evidence[a], evidence[b])[0]) >= LEAST_CORNERS for a in before for b in after)
