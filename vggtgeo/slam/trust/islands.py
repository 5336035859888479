"""Stretches of frames that hang on the rest of the map by little: after tracking was lost, or the picture jumped.

Whoever is lost and believes that it was found again may stand anywhere, and from then on everything agrees with that:
what it sees is tracked against a keyframe of its own. Fifteen mirrored frames of icl-office were lost for four, then
placed by 12 of 32 matches and a third of a wall, 32 cm aside, and called good. So frames are cut into stretches, at
lost frames and at steps that nobody saw, and stretches are tied to each other by what chance does not give.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.evidence import BARE_OVERLAP, STRONG_INLIERS
from vggtgeo.slam.tracking.evidence import Evidence as PoseEvidence
from vggtgeo.slam.trust.blind import LEAST_INLIERS, seen_around
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.steps import LEAST_CORNERS, MOST_DISPLACED, Step, bridged

NEARLY_ALL = 0.8
"""Of a frame's matches. In mirrored pictures 12 of 32 and 28 of 55 agreed on a wrong pose; 23 of 26 where building-walk
came out of a white wall at the right one."""


def check_islands(slam: Slam, estimate: Estimate, evidence: Evidence, taken: list[Step]) -> list[Finding]:
    """Stretches that nothing sure ties to the part of the run that most frames are in."""
    stretches = list(_stretches(estimate, evidence, taken))
    if estimate.pieces > 1 or len(stretches) < 2:  # parts of a map are told as such
        return []
    ties = [*_seen(estimate, evidence, stretches), *_matched(slam, estimate, stretches)]
    ends = np.array(ties, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(ties)), (ends[0], ends[1])), (len(stretches), len(stretches)))
    _, group = connected_components(graph, directed=False)
    lengths = np.array([last - first + 1 for first, last in stretches])
    size = np.bincount(group, lengths)
    found = []
    for (first, last), own in zip(stretches, group, strict=True):
        if own == int(size.argmax()):
            continue
        start, end = int(estimate.frames[first]), int(estimate.frames[last])
        text = (
            f"frames {start} to {end} hang on the rest of the map by fewer than {STRONG_INLIERS} matches, from where "
            "tracking was lost or the picture jumped: they may be in a wrong place"
        )
        local = bool(size[own] <= MOST_DISPLACED * len(estimate))
        found.append(Finding("islands", "degraded", text, start, end, local=local))
    return found


def _seen(estimate: Estimate, evidence: Evidence, stretches: list[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Neighbouring stretches between which the followed corners agree with the poses."""
    for number in range(1, len(stretches)):
        if bridged(estimate, evidence, stretches[number - 1][1], stretches[number][0]):
            yield number - 1, number


def _sure(evidence: PoseEvidence) -> bool:
    """Whether many matches place a frame, fewer that nearly all agree, or surfaces of which it sees half."""
    nearly_all = evidence.inliers >= LEAST_INLIERS and evidence.share >= NEARLY_ALL
    by_surface = evidence.placed_by_surface and evidence.overlap >= BARE_OVERLAP
    return evidence.points_strong or nearly_all or by_surface


def _stretches(estimate: Estimate, evidence: Evidence, taken: list[Step]) -> Iterator[tuple[int, int]]:
    """First and last row of the tracked frames between lost ones and steps that nobody saw."""
    first = None
    for row in range(len(estimate)):
        seen = row == 0 or len(taken[row - 1].agrees) >= LEAST_CORNERS or seen_around(evidence, row - 1)
        if first is not None and not (estimate.tracked[row] and seen):
            yield first, row - 1
            first = None
        if first is None and estimate.tracked[row]:
            first = row
    if first is not None:
        yield first, len(estimate) - 1


def _matched(slam: Slam, estimate: Estimate, stretches: list[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Stretches that two keyframes tie by many matches that agree with their poses, or a frame and the keyframe that it
    was tracked against, by matches or surfaces.
    """
    ends = np.array([last for _, last in stretches])
    row_of = {int(frame): row for row, frame in enumerate(estimate.frames)}
    # What is of an earlier run, and lies in no stretch, counts to the first.
    of = [int(np.searchsorted(ends, row_of.get(keyframe.frame, 0))) for keyframe in slam.keyframes]
    yield from ((of[pair.first], of[pair.second]) for pair in slam.map.pairs if len(pair.points) >= STRONG_INLIERS)
    for number, (first, last) in enumerate(stretches):
        for record in slam.frames[first : last + 1]:
            # The frame of a keyframe hangs on itself, and came from an older one.
            against = record.reference if record.arrival is None else record.arrival[0]
            if _sure(record.evidence):
                yield number, of[against]
