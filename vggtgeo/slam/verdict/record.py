"""What the tracker recorded: whether the run started, which frames were lost, how many parts the map has.

A lost stretch of `T` seconds is bridged by assuming a smooth motion. A hand-held camera's acceleration has a standard
deviation of about `ACCELERATION`, so the middle of a bridge is off by `a T^2 / 8`, the end of a run that is not
relocalized by `a T^2 / 2`. The RMS over all frames is the effect on the trajectory error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from vggtgeo.slam.verdict.claim import Claim, extent
from vggtgeo.slam.verdict.finding import Finding, spans
from vggtgeo.slam.verdict.levels import ACCELERATION, MAX_BRIDGED, MAX_LOST, MIN_TRACKED, SHARE, UNMOVED
from vggtgeo.slam.verdict.windows import MIN_COMMON
from vggtgeo.slam.verdict.witness import FrameEvidence

AROUND = 3
"""Steps before and after a picture that is shown again, which tell the speed."""
MAX_SENTENCES = 5
"""Lost stretches that have a sentence each."""


def check_record(claim: Claim) -> list[Finding]:
    """Lost frames, parts of the map, a run that never started."""
    if not len(claim):
        return []
    if not claim.started or (len(claim) > 2 and np.count_nonzero(claim.tracked) <= 1):
        return [Finding("start", "failed", _never_started(claim))]
    found = []
    if len(claim) == 1 and not claim.in_known_map:
        found.append(Finding("start", "degraded", "the run has one frame: nothing can confirm its pose and its map"))
    if claim.guessed:
        text = "the camera is unknown, and too little was seen to estimate it; pass `--intrinsics`"
        found.append(Finding("camera", "degraded", text))
    found += _lost(claim)
    if claim.pieces > 1:
        text = (
            f"the map is in {claim.pieces} parts that are not connected; trajectory.txt and map.ply hold the one with "
            "most frames, trajectory-2.txt the next"
        )
        found.append(Finding("parts", "degraded", text))
    return found


def _lost(claim: Claim) -> list[Finding]:
    share = float(np.mean(claim.tracked))
    stretches = spans(~claim.tracked)
    serious = 1 - share > MAX_LOST or bridging_error(claim) > MAX_BRIDGED
    found = []
    for first, last in stretches:
        start, end = int(claim.frames[first]), int(claim.frames[last])
        text = f"frames {start} to {end} were lost; they have no pose"
        text = text if end > start else f"frame {start} was lost; it has no pose"
        local = not serious or len(stretches) > MAX_SENTENCES
        found.append(Finding("lost", "degraded", text, start, end, local=local))
    if serious and len(stretches) > MAX_SENTENCES:
        longest = max(found, key=lambda finding: (finding.end or 0) - (finding.start or 0))
        text = (
            f"{len(claim) - np.count_nonzero(claim.tracked)} of {len(claim)} frames were lost, {len(stretches)} times, "
            f"longest from frame {longest.start} to {longest.end}; they have no pose"
        )
        found.append(replace(longest, text=text, local=False))
    if share < MIN_TRACKED:
        found.append(Finding("lost", "failed", f"only {100 * share:.0f} % of the frames were tracked"))
    return found


def check_frozen(claim: Claim, corners: Sequence[FrameEvidence]) -> list[Finding]:
    """Pictures that were shown again while the camera moved on.

    Where a camera is at rest, the noise of a new picture still moves its corners a little: all of them in the very
    same place have no likelihood but that of the same picture. Meanwhile the camera goes on as before and after.
    """
    repeated = np.array([False, *(_same(*pair) for pair in pairwise(corners))], bool)
    speeds = np.linalg.norm(np.diff(claim.centres, axis=0), axis=1) / np.maximum(np.diff(claim.times), 1e-9)
    squares, found = 0.0, []
    for first, last in spans(repeated & claim.tracked):
        around = range(max(first - 1 - AROUND, 0), min(last + AROUND, len(speeds)))
        moving = [speeds[row] for row in around if not repeated[row + 1]]
        seconds = float(claim.times[last] - claim.times[first - 1])
        off = seconds * float(np.median(moving)) if moving else 0.0
        squares += (last - first + 1) * off**2 / 3
        found.append(f"{claim.frames[first]} to {claim.frames[last]}")
    off = float(np.sqrt(squares / max(len(claim), 1)))
    if not found or off <= (MAX_BRIDGED if claim.metric else SHARE * extent(claim.poses[claim.tracked])):
        return []
    told = ", ".join(found[:MAX_SENTENCES])
    text = f"frames {told} show the picture before them again, while the camera moved; film them again"
    return [Finding("frozen", "degraded", text)]


def _same(before: FrameEvidence, after: FrameEvidence) -> bool:
    """Whether two frames show one picture: most of their corners did not move at all."""
    _, first, second = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    moved = np.abs(before.pixels[first] - after.pixels[second]).max(1, initial=0.0)
    return len(first) >= MIN_COMMON and bool(np.median(moved) < UNMOVED)


def _never_started(claim: Claim) -> str:
    if not claim.in_known_map:
        return "the map was never started: not enough parallax or texture; the poses are meaningless"
    found, count = np.count_nonzero(claim.tracked), len(claim)
    return (
        f"{found} of {count} frames were found in the known map: they show another place, or the same one from "
        "elsewhere or in another light; there is no trajectory to use"
    )


def bridging_error(claim: Claim) -> float:
    """Metres, RMS over all frames, that the lost ones may be off."""
    squares = 0.0
    for first, last in spans(~claim.tracked):
        before, after = max(first - 1, 0), min(last + 1, len(claim) - 1)
        seconds = float(claim.times[after] - claim.times[before])
        open_end = first == 0 or last == len(claim) - 1
        error = ACCELERATION * seconds**2 / (2 if open_end else 8)
        squares += (last - first + 1) * error**2 / 2
    return float(np.sqrt(squares / max(len(claim), 1)))
