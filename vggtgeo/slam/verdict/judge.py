"""The verdict of a run: what the tracker lost, what is not determined, and what the corners explain better."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vggtgeo.datasets.check import PLAUSIBLE
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty, frame_uncertainty
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.alternatives import explain
from vggtgeo.slam.verdict.claim import Claim, extent
from vggtgeo.slam.verdict.corner_adjustment import Tracks
from vggtgeo.slam.verdict.corner_findings import findings
from vggtgeo.slam.verdict.corner_recorder import CornerTracks, FrameEvidence
from vggtgeo.slam.verdict.finding import Finding, Verdict, conclude
from vggtgeo.slam.verdict.thresholds import MAX_UNKNOWN, MIN_SENSOR_DEPTH
from vggtgeo.slam.verdict.tracking_findings import check_frozen, check_record
from vggtgeo.slam.verdict.windows import linked, thinned, tracks_of, windows


def judge(slam: Slam, evidence: CornerTracks = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """Judge the state after the last adjustment.

    Args:
        slam: the state.
        evidence: of all frames, from an `EvidenceRecorder`; without it only the run's own record counts.
        input_findings: what is known of the input already.

    """
    claim = Claim.of(slam)
    known = stated_share(claim, frame_uncertainty(slam) if slam.keyframes else None)
    found = [*input_findings, *check_record(claim), *check_extent(claim, known)]
    corners = aligned(slam, claim, evidence) if claim.started and len(claim) > 1 else None
    if corners is not None:
        found += [*check_unit(claim, corners), *check_frozen(claim, corners)]
        found += findings(claim, [explain(tracks) for tracks in tracks_of_windows(slam, claim, corners)], known)
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


def stated_share(claim: Claim, known: PoseUncertainty | None) -> float:
    """Return the median standard deviation of the places, as the run states it, over their spread; 0 if unknown."""
    if known is None or not np.isfinite(known.translation).any():
        return 0.0
    return float(np.nanmedian(known.translation)) / max(extent(claim.poses[claim.tracked]), 1e-12)


def check_extent(claim: Claim, share: float) -> list[Finding]:
    """Check whether a path without depth is longer than its stated error. share: as `stated_share` returns it."""
    if claim.metric or share < MAX_UNKNOWN:
        return []
    text = (
        f"the camera positions are uncertain by {min(100 * share, 100):.0f} % of the extent of the path: the camera "
        "turns more than it moves, and without depth the path is not determined. Film more sideways motion, or record "
        "depth"
    )
    return [Finding("extent", "degraded", text)]


def check_unit(claim: Claim, corners: Sequence[FrameEvidence]) -> list[Finding]:
    """Check that measured depths are in the range of sensors for rooms: images alone cannot show a wrong unit."""
    depths = np.concatenate([frame.depth for frame in corners])
    depths = depths[np.isfinite(depths)]
    if not claim.metric or not len(depths):
        return []
    near, middle = np.quantile(depths, [0.1, 0.5])
    if near >= MIN_SENSOR_DEPTH and PLAUSIBLE[0] <= middle <= PLAUSIBLE[1]:
        return []
    text = (
        f"lengths may not be metres: the median depth of the corners is {middle:.2g} m, and a tenth of them is within "
        f"{near:.2g} m, outside the range of sensors for rooms. Check the unit of the depth images"
    )
    return [Finding("depth unit", "degraded", text, scale=True)]


def tracks_of_windows(slam: Slam, claim: Claim, corners: Sequence[FrameEvidence]) -> list[Tracks]:
    """Return the corner tracks of each window."""
    height, width = slam.keyframes[0].size
    stretches = linked(corners, claim.tracked)
    rows = (rows for stretch in stretches for rows in windows(thinned(corners, stretch)))
    found = (tracks_of(claim, corners, some, (width, height)) for some in rows)
    return [tracks for tracks in found if tracks is not None]


def aligned(slam: Slam, claim: Claim, evidence: CornerTracks) -> Sequence[FrameEvidence] | None:
    """Return the corners of each frame of the run, undistorted as it estimated; None if some are missing."""
    by_frame = {noted.frame: noted for noted in evidence}
    if any(frame not in by_frame for frame in claim.frames):
        return None
    found = [by_frame[frame] for frame in claim.frames]
    return found if slam.camera.lens is None else [noted.through(slam.camera.lens) for noted in found]
