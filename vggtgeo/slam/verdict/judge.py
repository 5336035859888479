"""The verdict of a run: what the tracker lost, what is not determined, and what the corners explain better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.datasets.check import PLAUSIBLE
from vggtgeo.slam.global_map.pose_uncertainty import frame_uncertainty
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.evidence import STRONG_INLIERS
from vggtgeo.slam.verdict.alternatives import Explanation, explain
from vggtgeo.slam.verdict.claim import Claim, extent
from vggtgeo.slam.verdict.decision import findings, noted
from vggtgeo.slam.verdict.finding import Finding, Noted, Verdict, conclude
from vggtgeo.slam.verdict.levels import MAX_LOST, MAX_UNKNOWN, NEAREST
from vggtgeo.slam.verdict.record import check_frozen, check_record
from vggtgeo.slam.verdict.windows import linked, thinned, tracks_of, windows
from vggtgeo.slam.verdict.witness import Evidence, FrameEvidence

MIN_FRAMES = 4
"""Frames of a window; in fewer, free poses explain nearly all."""


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
    corners = aligned(slam, claim, evidence) if claim.started and len(claim) > 1 else None
    without_consequence: list[Noted] = []
    if corners is not None:
        found += [*check_unit(claim, corners), *check_frozen(claim, corners)]
        stretches = linked(corners, claim.tracked)
        found += unlinked(slam, claim, stretches)
        explained = explanations(slam, claim, corners, stretches)
        stated = np.zeros(1) if known is None else known.translation[np.isfinite(known.translation)]
        found += findings(claim, explained, float(np.median(stated)) if len(stated) else 0.0)
        without_consequence = noted(claim, explained)
    verdict = conclude(found, claim.frames.tolist(), claim.times.tolist(), claim.metric)
    return replace(verdict, noted=tuple(without_consequence))


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
    share = float(np.nanmedian(sigma)) / max(extent(claim.poses[claim.tracked]), 1e-12)
    if share < MAX_UNKNOWN:
        return []
    text = (
        f"the places are known to {min(100 * share, 100):.0f} % of their spread only: the camera turns more than it "
        "moves, and without depth the path is not determined"
    )
    return [Finding("extent", "degraded", text)]


def check_unit(claim: Claim, corners: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether measured depths are in the range of sensors for rooms: images alone cannot tell a wrong unit."""
    depths = np.concatenate([frame.depth for frame in corners])
    depths = depths[np.isfinite(depths)]
    if not claim.metric or not len(depths):
        return []
    near, middle = np.quantile(depths, [0.1, 0.5])
    if near >= NEAREST and PLAUSIBLE[0] <= middle <= PLAUSIBLE[1]:
        return []
    text = (
        f"the median depth of the corners is {middle:.2g} m, and a tenth of them is within {near:.2g} m, outside the "
        "range of sensors for rooms: check the unit of the depth images"
    )
    return [Finding("depth unit", "degraded", text, scale=True)]


def unlinked(slam: Slam, claim: Claim, stretches: Sequence[np.ndarray]) -> list[Finding]:
    """Stretches of frames that neither corners nor `STRONG_INLIERS` matches of keyframes link to the largest one."""
    if len(stretches) < 2:
        return []
    stretch_of = np.full(len(claim), -1)
    for number, rows in enumerate(stretches):
        stretch_of[rows] = number
    row_of = {int(frame): row for row, frame in enumerate(claim.frames)}
    place = {key.number: stretch_of[row_of[key.frame]] for key in slam.keyframes if key.frame in row_of}
    known = [
        pair
        for pair in slam.map.pairs
        if len(pair.points) >= STRONG_INLIERS and {pair.first, pair.second} <= place.keys()
    ]
    ends = [(place[pair.first], place[pair.second]) for pair in known]
    for record in slam.frames:
        against = record.reference if record.arrival is None else record.arrival[0]
        if record.tracked and against in place and (record.evidence.points_strong or record.evidence.placed_by_surface):
            ends.append((stretch_of[row_of[record.frame]], place[against]))
    first, second = np.array([end for end in ends if min(end) >= 0], int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(first)), (first, second)), (len(stretches),) * 2)
    _, label = connected_components(graph, directed=False)
    main = np.bincount(label, [len(rows) for rows in stretches]).argmax()
    found = []
    for rows in (rows for number, rows in enumerate(stretches) if label[number] != main):
        start, end = int(claim.frames[rows[0]]), int(claim.frames[rows[-1]])
        text = f"frames {start} to {end} hang on the rest by few matches only: their place is not confirmed"
        found.append(Finding("link", "degraded", text, start, end, local=len(rows) < MAX_LOST * len(claim)))
    return found


def explanations(
    slam: Slam, claim: Claim, corners: Sequence[FrameEvidence], stretches: Sequence[np.ndarray]
) -> list[Explanation]:
    """What the corners of each window prefer."""
    height, width = slam.keyframes[0].size
    found = []
    for stretch in stretches:
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
    return found if slam.camera.lens is None else [noted.through(slam.camera.lens) for noted in found]
