"""The verdict of a run: what the tracker lost, what is not determined, and what the corners explain better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.slam.global_map.pose_uncertainty import frame_uncertainty
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.alternatives import explain
from vggtgeo.slam.verdict.claim import Claim
from vggtgeo.slam.verdict.corner_findings import findings
from vggtgeo.slam.verdict.corner_recorder import CornerTracks
from vggtgeo.slam.verdict.corner_tracks import tracks_of_windows
from vggtgeo.slam.verdict.finding import Finding, Verdict, conclude
from vggtgeo.slam.verdict.run_findings import check_extent, check_frozen, check_record, check_unit, stated_share


def judge(slam: Slam, evidence: CornerTracks = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """Judge the state after the last adjustment.

    evidence: of all frames, from an `EvidenceRecorder`; without it only the run's own record counts. input_findings:
    what is known of the input already.
    """
    claim = Claim.of(slam)
    known = stated_share(claim, frame_uncertainty(slam) if slam.keyframes else None)
    found = [*input_findings, *check_record(claim), *check_extent(claim, known)]
    corners = aligned(slam, claim, evidence) if claim.started and len(claim) > 1 else None
    if corners is not None:
        height, width = slam.keyframes[0].size
        explanations = [explain(tracks) for tracks in tracks_of_windows(claim, corners, (width, height))]
        found += check_unit(claim, corners) + check_frozen(claim, corners) + findings(claim, explanations, known)
    return conclude(found, claim.frames.tolist(), claim.times.tolist(), claim.metric)


def judge_or_report(slam: Slam, evidence: CornerTracks = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """Call `judge`; an error in it becomes a finding, so that the result of a long run is not lost."""
    try:
        return judge(slam, evidence, input_findings)
    except Exception as error:  # noqa: BLE001 - of any kind: the result exists, and is worth more than its verdict
        text = f"the verdict ended in an error ({type(error).__name__}: {error}): the result is unchecked"
        claim = Claim.of(slam)
        found = [*input_findings, Finding("verdict", "degraded", text)]
        return conclude(found, claim.frames.tolist(), claim.times.tolist(), claim.metric)


def aligned(slam: Slam, claim: Claim, evidence: CornerTracks) -> CornerTracks | None:
    """Return the corners of each frame of the run, undistorted as it estimated; None if some are missing."""
    by_frame, lens = {noted.frame: noted for noted in evidence}, slam.camera.lens
    if any(frame not in by_frame for frame in claim.frames):
        return None
    found = [by_frame[frame] for frame in claim.frames]
    if lens is None:
        return found
    return [replace(noted, pixels=lens.undistorted(noted.pixels).astype(np.float32)) for noted in found]
