"""The verdict of a run: every check on what it claims and on what was seen."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from vggtgeo.slam.global_map.pose_uncertainty import frame_uncertainty
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import pieces_by_size
from vggtgeo.slam.trust.blind import check_blind, cuts
from vggtgeo.slam.trust.calibration import camera_opinion, check_camera
from vggtgeo.slam.trust.change_of_sides import check_sides
from vggtgeo.slam.trust.contradicted import check_matches
from vggtgeo.slam.trust.depth_agreement import agree, check_depth, depth_ratios
from vggtgeo.slam.trust.depth_images import check_frozen, check_range
from vggtgeo.slam.trust.edges import check_edges
from vggtgeo.slam.trust.enlargement import check_enlargements
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence
from vggtgeo.slam.trust.extent import check_extent
from vggtgeo.slam.trust.finding import Finding, Verdict, conclude
from vggtgeo.slam.trust.focal_length import check_focal_length
from vggtgeo.slam.trust.frozen_pictures import check_frozen_pictures
from vggtgeo.slam.trust.islands import check_islands
from vggtgeo.slam.trust.own_points import check_own_points
from vggtgeo.slam.trust.pace import pace
from vggtgeo.slam.trust.parallax import check_parallax
from vggtgeo.slam.trust.record import check_record
from vggtgeo.slam.trust.reversal import check_reversal
from vggtgeo.slam.trust.scale_drift import check_scale, hand_overs
from vggtgeo.slam.trust.scale_hand_over import check_hand_over
from vggtgeo.slam.trust.sensor_drift import check_sensors
from vggtgeo.slam.trust.shutter import check_shutter, corners_at_once
from vggtgeo.slam.trust.speed import check_speed
from vggtgeo.slam.trust.steps import breaks, check_steps, steps
from vggtgeo.slam.trust.still_points import check_parts, divide
from vggtgeo.slam.trust.surfaces import check_surfaces
from vggtgeo.slam.trust.zoom import check_zoom


def judge(slam: Slam, evidence: Evidence = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """How far the state after the last adjustment can be trusted.

    evidence: of all frames, from an `EvidenceRecorder`; without it only the run's own record counts.
    input_findings: what is known of the input already.
    """
    estimate = Estimate.of(slam)
    by_frame = {noted.frame: noted for noted in evidence}
    aligned = [by_frame[frame] for frame in estimate.frames if frame in by_frame]
    if slam.camera.lens is not None:
        aligned = [noted.through(slam.camera.lens) for noted in aligned]
    if len(aligned) == len(slam.frames):
        aligned = corners_at_once(slam, aligned)
    known = frame_uncertainty(slam) if slam.keyframes else None
    found = [*input_findings, *check_record(estimate)]
    found += check_extent(estimate, None if known is None else known.translation)
    if estimate.started and estimate.metric:
        found += check_surfaces(slam.keyframes, estimate.intrinsics)
    if estimate.started:
        found += check_hand_over(slam)
        found += check_parallax(slam)
        found += check_zoom(slam)
        found += check_reversal(slam)
        found += check_focal_length(slam)
        found += check_own_points(slam, estimate.poses)
    for piece in pieces_by_size(slam) if estimate.started else ():
        own = [keyframe for number in piece if (keyframe := slam.keyframes[number]).recorded is None]
        found += check_matches(own, estimate.intrinsics, estimate.pieces == 1, estimate.metric)
    if estimate.started and len(estimate) > 1 and len(aligned) == len(estimate):
        height, width = slam.keyframes[0].size
        found += _images(slam, estimate, aligned, (width, height))
        if any(np.isfinite(noted.depth_median) for noted in aligned):
            found += check_sensors(slam)
    else:
        found += check_speed(estimate)
    return conclude(found, estimate.frames.tolist(), estimate.times.tolist(), estimate.metric)


def judged_or_told(slam: Slam, evidence: Evidence = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """As `judge`; a fault of a check is told, and loses nobody the result of hours."""
    try:
        return judge(slam, evidence, input_findings)
    except Exception as fault:  # noqa: BLE001 - of any kind: the result is there, and is worth more than its verdict
        text = (
            f"a check ended in an error ({type(fault).__name__}: {fault}), a fault of this program that its authors "
            "would like to know of; how far the result can be trusted is not known"
        )
        estimate = Estimate.of(slam)
        found = [*input_findings, Finding("checks", "degraded", text)]
        return conclude(found, estimate.frames.tolist(), estimate.times.tolist(), estimate.metric)


def _images(slam: Slam, estimate: Estimate, evidence: Evidence, size: tuple[int, int]) -> Iterator[Finding]:
    taken = steps(estimate, evidence)
    wrong = breaks(estimate, evidence, taken)
    yield from check_speed(estimate, cuts(estimate, evidence, taken))
    yield from check_steps(estimate, taken, wrong)
    yield from check_sides(estimate, taken)
    yield from check_blind(estimate, evidence, taken)
    yield from check_islands(slam, estimate, evidence, taken)
    yield from check_parts(estimate, [divide(step) for step in taken])
    ratios = depth_ratios(estimate, evidence, pace(estimate, evidence))
    yield from check_depth(estimate, ratios)
    yield from check_frozen(estimate, evidence, harmless=partial(agree, ratios))
    yield from check_frozen_pictures(estimate, evidence)
    yield from check_range(estimate, evidence)
    yield from check_edges(estimate, np.array([noted.edges_elsewhere for noted in evidence], np.float64))
    sound = np.ones(len(estimate), bool)
    for part in wrong:
        sound[part.first : part.last + 2] = False
    yield from check_scale(estimate, hand_overs(estimate, evidence, sound))
    yield from check_camera(estimate, camera_opinion(estimate, evidence), size)
    yield from check_shutter(estimate)
    yield from check_enlargements(estimate, np.array([noted.enlarged for noted in evidence], np.float64))
