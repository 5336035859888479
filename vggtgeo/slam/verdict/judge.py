"""The verdict of a run: what the tracker lost, what is not determined, and what the corners explain better."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vggtgeo.slam.global_map.pose_uncertainty import frame_uncertainty
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.alternatives import Explanation, explain
from vggtgeo.slam.verdict.claim import Claim
from vggtgeo.slam.verdict.decision import findings
from vggtgeo.slam.verdict.finding import Finding, Verdict, conclude
from vggtgeo.slam.verdict.record import check_record
from vggtgeo.slam.verdict.windows import linked, thinned, tracks_of, windows
from vggtgeo.slam.verdict.witness import Evidence, FrameEvidence

MIN_FRAMES = 4
"""Frames of a window; in fewer, free poses explain nearly all."""
MAX_UNKNOWN = 0.55
"""Median standard deviation of the places over their spread, beyond which a path without depth has no shape."""


def judge(slam: Slam, evidence: Evidence = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """Judge the state after the last adjustment.

    Args:
        slam: the state.
        evidence: of all frames, from an `EvidenceRecorder`; without it only the run's own record counts.
        input_findings: what is known of the input already.

    """
    claim = Claim.of(slam)
    found = [*input_findings, *check_record(claim)]
    known = frame_uncertainty(slam) if slam.keyframes else None
    found += check_extent(claim, None if known is None else known.translation)
    if claim.started and len(claim) > 1:
        found += findings(claim, explanations(slam, claim, evidence))
    return conclude(found, claim.frames.tolist(), claim.times.tolist(), claim.metric)


def judge_or_report(slam: Slam, evidence: Evidence = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """Call `judge`; an error in it becomes a finding, so that the result of a long run is not lost."""
    try:
        return judge(slam, evidence, input_findings)
    except Exception as error:  # noqa: BLE001 - of any kind: the result exists, and is worth more than its verdict
        text = f"the verdict ended in an error ({type(error).__name__}: {error}): the result is unchecked"
        claim = Claim.of(slam)
        found = [*input_findings, Finding("verdict", "degraded", text)]
        return conclude(found, claim.frames.tolist(), claim.times.tolist(), claim.metric)


def check_extent(claim: Claim, sigma: np.ndarray | None) -> list[Finding]:
    """Whether a path without depth is longer than its stated error.

    sigma: float64 [m], standard deviations of the places, in the unit of the map, NaN = unknown; None: none is known.
    """
    if claim.metric or sigma is None or not np.isfinite(sigma).any():
        return []
    centres = claim.centres[claim.tracked]
    spread = float(np.sqrt(np.mean(np.sum((centres - centres.mean(0)) ** 2, 1))))
    share = float(np.nanmedian(sigma)) / max(spread, 1e-12)
    if share < MAX_UNKNOWN:
        return []
    text = (
        f"the places are known to {min(100 * share, 100):.0f} % of their spread only: the camera turns more than it "
        "moves, and without depth the path is not determined"
    )
    return [Finding("extent", "degraded", text)]


def explanations(slam: Slam, claim: Claim, evidence: Evidence) -> list[Explanation]:
    """What the corners of each window prefer; none where evidence of a frame is missing."""
    corners = aligned(slam, claim, evidence)
    if corners is None:
        return []
    height, width = slam.keyframes[0].size
    found = []
    for stretch in linked(corners, claim.tracked):
        for rows in windows(thinned(corners, stretch)):
            tracks = tracks_of(claim, corners, rows, (width, height)) if len(rows) >= MIN_FRAMES else None
            if tracks is not None:
                found.append(explain(tracks))
    return found


def aligned(slam: Slam, claim: Claim, evidence: Evidence) -> Sequence[FrameEvidence] | None:
    """The corners of each frame of the run, without the distortion that it estimated; None where some are missing."""
    by_frame = {noted.frame: noted for noted in evidence}
    if any(frame not in by_frame for frame in claim.frames):
        return None
    found = [by_frame[frame] for frame in claim.frames]
    return found if slam.lens is None else [noted.through(slam.lens) for noted in found]
