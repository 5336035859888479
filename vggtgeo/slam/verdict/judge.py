"""The verdict of a run: what the tracker lost, what is not determined, and what the corners explain better."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from vggtgeo.datasets.check import PLAUSIBLE_MEDIAN_DEPTH
from vggtgeo.geometry import rigid
from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.models.onnx.bounds import Refusals
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty, frame_uncertainty
from vggtgeo.slam.perception.static_overlay import StaticOverlay
from vggtgeo.slam.state import Slam, stretches
from vggtgeo.slam.verdict import thresholds
from vggtgeo.slam.verdict.alternatives import explain
from vggtgeo.slam.verdict.claim import Claim, Tracks, extent, max_place_error, tracks_of_windows
from vggtgeo.slam.verdict.corner_findings import findings
from vggtgeo.slam.verdict.corner_recorder import CornerTracks, FrameCorners
from vggtgeo.slam.verdict.findings import Finding, Level, Verdict, conclude


def judge(slam: Slam, evidence: CornerTracks = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """Judge the state after the last adjustment. evidence: of all frames, from a `CornerRecorder`; without it only
    the run's own record counts. input_findings: what is known of the input already.
    """
    claim = Claim.of(slam)
    known = stated_share(claim, frame_uncertainty(slam) if slam.keyframes else None)
    found = [*input_findings, *check_record(claim), *check_extent(claim, known)]
    corners = aligned(slam, claim, evidence) if claim.started and len(claim) > 1 else None
    if corners is not None:
        height, width = slam.keyframes[0].size
        windows = tracks_of_windows(claim, corners, (width, height))
        found += check_unit(claim, corners) + check_frozen(claim, corners) + check_unseen(claim, windows)
        found += findings(claim, [explain(tracks) for tracks in windows], known)
    return conclude(found, claim.frames.tolist(), claim.times.tolist(), claim.metric)


def judge_or_report(slam: Slam, evidence: CornerTracks = (), input_findings: tuple[Finding, ...] = ()) -> Verdict:
    """Call `judge`; an error in it becomes a finding, so that the result of a long run is not lost."""
    try:
        return judge(slam, evidence, input_findings)
    except Exception as error:  # noqa: BLE001 - of any kind: the result exists, and is worth more than its verdict
        text = f"the verdict ended in an error ({type(error).__name__}: {error}): the result is unchecked"
        frames, times = [record.frame for record in slam.frames], [record.timestamp for record in slam.frames]
        return conclude([*input_findings, Finding("verdict", "degraded", text)], frames, times, slam.metric)


def aligned(slam: Slam, claim: Claim, evidence: CornerTracks) -> CornerTracks | None:
    """Return the corners of each frame of the run, undistorted as it estimated; None if none were recorded."""
    by_frame, lens = {noted.frame: noted for noted in evidence}, slam.camera.lens
    if not evidence:
        return None
    empty = replace(evidence[0], ids=evidence[0].ids[:0], pixels=evidence[0].pixels[:0], depth=evidence[0].depth[:0])
    found = [by_frame.get(frame, empty) for frame in claim.frames.tolist()]
    if lens is None:
        return found
    return [replace(noted, pixels=lens.undistorted(noted.pixels).astype(np.float32)) for noted in found]


def check_refusals(refusals: Mapping[str, Refusals]) -> tuple[Finding, ...]:
    """Check for roles whose network gave invalid answers, or none."""
    text = "the network of {} gave no valid answer {} of {} times: ignored"
    bad = ((role, counts) for role, counts in refusals.items() if counts.share > thresholds.MAX_LOST)
    return tuple(Finding("network", "degraded", text.format(role, c.without, c.asked)) for role, c in bad)


def check_input(warned: Iterable[Warning | str], frames: int) -> tuple[Finding, ...]:
    """Check for frames that a reader skipped, beside `frames` that it gave."""
    missing = sum(warning.frames for warning in warned if isinstance(warning, LeftOutWarning))
    if missing <= thresholds.MAX_LOST * (missing + frames):
        return ()
    text = f"{missing} of {missing + frames} frames of the input were left out (see the warnings)"
    return (Finding("input", "degraded", text),)


def check_static_overlay(seen: StaticOverlay | None, left_out: bool) -> tuple[Finding, ...]:
    """Check for a static part of the picture that was not masked, or may not belong to the camera."""
    if seen is None or (left_out and seen.sure):
        return ()
    done = "masked" if left_out else "not masked"
    text = f"{100 * seen.share:.0f} % of the picture stays still while the rest moves ({done}): either may be the scene"
    return (Finding("still parts", "degraded", text),)


def check_record(claim: Claim) -> list[Finding]:
    """Check for lost frames, unconnected submaps, and a run that never started."""
    if not len(claim):
        return []
    tracked = np.count_nonzero(claim.tracked)
    if not claim.started or (len(claim) > 2 and tracked <= 1):
        text = (
            "the poses are meaningless: the map was never started, for lack of sideways motion or of texture; begin "
            "with sideways motion, or skip frames with `--start`"
        )
        if claim.began_in_known_map:
            text = (
                f"{tracked} of {len(claim)} frames were found in the known map: they show another place, or the same "
                "one from elsewhere or in another light; there is no trajectory to use"
            )
        return [Finding("start", "failed", text)]
    found = []
    if len(claim) == 1 and not claim.began_in_known_map:
        found.append(Finding("start", "degraded", "the run has one frame: nothing can confirm its pose and its map"))
    if claim.guessed:
        text = "the camera is unknown, and too little was seen to estimate it. Pass `--intrinsics`"
        found.append(Finding("camera", "degraded", text))
    found += _lost(claim)
    if claim.submaps > 1:
        text = (
            f"the map is in {claim.submaps} submaps whose relative position and scale are unknown: trajectory.txt and "
            "map.ply hold the one with most frames. Film again with overlap, or use each submap by itself"
        )
        found.append(Finding("submaps", "degraded", text))
    return found


def _lost(claim: Claim) -> list[Finding]:
    # A stretch of T seconds is bridged by assuming a smooth motion. With the acceleration `a` of a hand-held camera its
    # middle is off by `a T^2 / 8`, the end of a run that is not relocalized by `a T^2 / 2`; RMS over all frames.
    found, squares, parts, newest = [], 0.0, stretches(~claim.tracked), len(claim) - 1
    for first, last in parts:
        start, end, _ = claim.span(first, last)
        found.append(Finding("lost", "degraded", f"frames {start} to {end} were lost", start, end, local=True))
        seconds = float(claim.times[min(last + 1, newest)] - claim.times[max(first - 1, 0)])
        error = thresholds.ACCELERATION * seconds**2 / (2 if first == 0 or last == newest else 8)
        squares += (last - first + 1) * error**2 / 2
    count = len(claim) - np.count_nonzero(claim.tracked)
    if count > thresholds.MAX_LOST * len(claim) or np.sqrt(squares / len(claim)) > thresholds.MAX_PLACE_ERROR:
        start, end, _ = claim.span(*max(parts, key=lambda rows: claim.frames[rows[1]] - claim.frames[rows[0]]))
        text = f"{count} of {len(claim)} frames were lost and have no pose; the longest gap is frames {start} to {end}"
        level: Level = "failed" if len(claim) - count < thresholds.MIN_TRACKED * len(claim) else "degraded"
        found.append(Finding("lost", level, text, start, end))
    return found


def stated_share(claim: Claim, known: PoseUncertainty | None) -> float:
    """Return the median standard deviation of the places, as the run states it, over their spread; 0 if unknown."""
    if known is None or not np.isfinite(known.translation).any():
        return 0.0
    return float(np.nanmedian(known.translation)) / extent(claim.poses[claim.tracked])


def check_extent(claim: Claim, share: float) -> list[Finding]:
    """Check whether a path without depth is longer than its stated error. share: as `stated_share` returns it."""
    if claim.metric or share < thresholds.MAX_UNKNOWN:
        return []
    text = (
        f"the camera positions are uncertain by {min(100 * share, 100):.0f} % of the extent of the path: without depth "
        "it is not determined. Film more sideways motion, or record depth"
    )
    return [Finding("extent", "degraded", text)]


def check_unseen(claim: Claim, windows: list[Tracks]) -> list[Finding]:
    """Note the frames that no window of corners tests. It is no reason against a result: photos share few corners."""
    unseen = claim.tracked.copy()
    for tracks in windows:
        unseen[tracks.rows[0] : tracks.rows[-1] + 1] = False
    count = np.count_nonzero(unseen)
    text = f"the poses of {count} of {len(claim)} frames could not be tested: too few corners link them to the next"
    return [Finding("unseen", "good", text)] if count > thresholds.MAX_LOST * len(claim) else []


def check_unit(claim: Claim, corners: CornerTracks) -> list[Finding]:
    """Check that measured depths are in the range of sensors for rooms: images alone cannot show a wrong unit."""
    depths = np.concatenate([frame.depth[np.isfinite(frame.depth)] for frame in corners])
    if not claim.metric or not len(depths):
        return []
    near, middle = np.quantile(depths, [0.1, 0.5])
    if near >= thresholds.MIN_SENSOR_DEPTH and PLAUSIBLE_MEDIAN_DEPTH[0] <= middle <= PLAUSIBLE_MEDIAN_DEPTH[1]:
        return []
    text = (
        f"lengths may not be metres: the median depth of the corners is {middle:.2g} m, and a tenth of them is within "
        f"{near:.2g} m, outside the range of sensors for rooms. Check the unit of the depth images"
    )
    return [Finding("depth unit", "degraded", text, scale=True)]


def check_frozen(claim: Claim, corners: CornerTracks) -> list[Finding]:
    """Check for pictures that were repeated while the camera moved on, at its usual speed. Where it is at rest, the
    noise of a new picture still moves its corners a little: all of them in the very same place are of the same picture.
    """
    repeated = np.array([False, *(_same_picture(*pair) for pair in pairwise(corners))], bool)
    parts = stretches(repeated & claim.tracked)
    moved = ~repeated[1:] & claim.tracked[1:] & claim.tracked[:-1]
    if not parts or not moved.any():
        return []
    steps = np.linalg.norm(np.diff(rigid.centres(claim.poses), axis=0), axis=1)
    speed = np.median((steps / np.maximum(np.diff(claim.times), 1e-9))[moved])
    squares = [(last - first + 1) * (claim.times[last] - claim.times[first - 1]) ** 2 / 3 for first, last in parts]
    if speed * np.sqrt(sum(squares) / len(claim)) <= max_place_error(claim.metric, claim.poses[claim.tracked]):
        return []
    start, end, where = claim.span(*max(parts, key=lambda ends: ends[1] - ends[0]))
    text = (
        f"{where} repeat the picture before them, while the camera moved: their poses are guesses. Film this part "
        "again, or do not use it"
    )
    return [Finding("frozen", "degraded", text, start, end)]


def _same_picture(before: FrameCorners, after: FrameCorners) -> bool:
    first, second = before.common(after)
    moved = np.abs(before.pixels[first] - after.pixels[second]).max(1, initial=0.0)
    return len(first) >= thresholds.MIN_COMMON and bool(np.median(moved) < thresholds.MAX_UNMOVED)
