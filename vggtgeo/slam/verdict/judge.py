"""The verdict of a run: what the tracker lost, what nothing links, and what the corners explain better."""

from __future__ import annotations

from collections.abc import Sequence

from vggtgeo.slam.global_map.pose_uncertainty import frame_uncertainty
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, FrameEvidence
from vggtgeo.slam.trust.extent import check_extent
from vggtgeo.slam.trust.finding import Finding, Verdict, conclude
from vggtgeo.slam.trust.record import check_record
from vggtgeo.slam.verdict.alternatives import Explanation, explain
from vggtgeo.slam.verdict.decision import findings
from vggtgeo.slam.verdict.windows import linked, thinned, tracks_of, windows

MIN_FRAMES = 4
"""Frames of a window: fewer have nothing to be compared with."""


def judge(slam: Slam, evidence: Evidence = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """Judge the state after the last adjustment.

    Args:
        slam: the state.
        evidence: of all frames, from an `EvidenceRecorder`; without it only the run's own record counts.
        input_findings: what is known of the input already.

    """
    estimate = Estimate.of(slam)
    found = [*input_findings, *check_record(estimate)]
    known = frame_uncertainty(slam) if slam.keyframes else None
    found += check_extent(estimate, None if known is None else known.translation)
    if estimate.started and len(estimate) > 1:
        found += findings(estimate, explanations(slam, estimate, evidence))
    return conclude(found, estimate.frames.tolist(), estimate.times.tolist(), estimate.metric)


def explanations(slam: Slam, estimate: Estimate, evidence: Evidence) -> list[Explanation]:
    """What the corners of each window prefer; none where evidence of a frame is missing."""
    corners = aligned(slam, estimate, evidence)
    if corners is None:
        return []
    height, width = slam.keyframes[0].size
    found = []
    for stretch in linked(corners, estimate.tracked):
        for rows in windows(thinned(corners, stretch)):
            tracks = tracks_of(estimate, corners, rows, (width, height)) if len(rows) >= MIN_FRAMES else None
            if tracks is not None:
                found.append(explain(tracks))
    return found


def aligned(slam: Slam, estimate: Estimate, evidence: Evidence) -> Sequence[FrameEvidence] | None:
    """The corners of each frame of the run, without the lens that it found; None where some are missing."""
    by_frame = {noted.frame: noted for noted in evidence}
    if any(frame not in by_frame for frame in estimate.frames):
        return None
    found = [by_frame[frame] for frame in estimate.frames]
    return found if slam.lens is None else [noted.through(slam.lens) for noted in found]
