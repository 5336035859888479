"""Findings about tracking: a run that never started, lost frames, submaps that are not connected, repeated pictures.

A lost stretch of `T` seconds is bridged by assuming a smooth motion. A hand-held camera's acceleration has a standard
deviation of about `ACCELERATION`, so the middle of a bridge is off by `a T^2 / 8`, the end of a run that is not
relocalized by `a T^2 / 2`. The RMS over all frames is the effect on the trajectory error.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.claim import Claim, extent
from vggtgeo.slam.verdict.corner_recorder import FrameEvidence
from vggtgeo.slam.verdict.finding import Finding, Level, spans
from vggtgeo.slam.verdict.thresholds import (
    ACCELERATION,
    MAX_LOST,
    MAX_PLACE_ERROR,
    MAX_PLACE_ERROR_SHARE,
    MAX_UNMOVED,
    MIN_COMMON,
    MIN_TRACKED,
)


def check_record(claim: Claim) -> list[Finding]:
    """Check for lost frames, unconnected submaps, and a run that never started."""
    if not len(claim):
        return []
    if not claim.started or (len(claim) > 2 and np.count_nonzero(claim.tracked) <= 1):
        return [Finding("start", "failed", _never_started(claim))]
    found = []
    if len(claim) == 1 and not claim.began_in_known_map:
        found.append(Finding("start", "degraded", "the run has one frame: nothing can confirm its pose and its map"))
    if claim.guessed:
        text = "the camera is unknown, and too little was seen to estimate it. Pass `--intrinsics`"
        found.append(Finding("camera", "degraded", text))
    found += _lost(claim)
    if claim.submaps > 1:
        text = (
            f"the map is in {claim.submaps} submaps whose relative position and scale are unknown: tracking was "
            "lost between them; trajectory.txt and map.ply hold the one with most frames, trajectory-2.txt the next. "
            "Film again with overlap, or use each submap by itself"
        )
        found.append(Finding("submaps", "degraded", text))
    return found


def _lost(claim: Claim) -> list[Finding]:
    stretches = spans(~claim.tracked)
    named = [(int(claim.frames[first]), int(claim.frames[last])) for first, last in stretches]
    found = [Finding("lost", "degraded", f"frames {a} to {b} were lost", a, b, local=True) for a, b in named]
    count = len(claim) - np.count_nonzero(claim.tracked)
    if count > MAX_LOST * len(claim) or bridging_error(claim) > MAX_PLACE_ERROR:
        start, end = max(named, key=lambda ends: ends[1] - ends[0])
        times = "once" if len(named) == 1 else f"{len(named)} times, longest"
        text = f"{count} of {len(claim)} frames were lost and have no pose, {times} from frame {start} to {end}"
        level: Level = "failed" if len(claim) - count < MIN_TRACKED * len(claim) else "degraded"
        found.append(Finding("lost", level, text, start, end))
    return found


def check_frozen(claim: Claim, corners: Sequence[FrameEvidence]) -> list[Finding]:
    """Check for pictures that were repeated while the camera moved on, at its usual speed.

    Where a camera is at rest, the noise of a new picture still moves its corners a little: all of them in the very
    same place have no likelihood but that of the same picture.
    """
    repeated = np.array([False, *(_same(*pair) for pair in pairwise(corners))], bool)
    stretches = spans(repeated & claim.tracked)
    if not stretches or repeated[1:].all():
        return []
    speeds = np.linalg.norm(np.diff(rigid.centres(claim.poses), axis=0), axis=1) / np.maximum(
        np.diff(claim.times), 1e-9
    )
    squares = [(last - first + 1) * (claim.times[last] - claim.times[first - 1]) ** 2 / 3 for first, last in stretches]
    off = float(np.median(speeds[~repeated[1:]]) * np.sqrt(sum(squares) / len(claim)))
    if off <= (MAX_PLACE_ERROR if claim.metric else MAX_PLACE_ERROR_SHARE * extent(claim.poses[claim.tracked])):
        return []
    first, last = max(stretches, key=lambda ends: ends[1] - ends[0])
    start, end = int(claim.frames[first]), int(claim.frames[last])
    seconds = f"{claim.times[first]:.1f} to {claim.times[last]:.1f} s"
    text = (
        f"frames {start} to {end} ({seconds}) repeat the picture before them, while the camera moved: their poses are "
        "guesses. Film this part again, or do not use it"
    )
    return [Finding("frozen", "degraded", text, start, end)]


def _same(before: FrameEvidence, after: FrameEvidence) -> bool:
    """Return whether two frames show one picture: most of their corners did not move at all."""
    _, first, second = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    moved = np.abs(before.pixels[first] - after.pixels[second]).max(1, initial=0.0)
    return len(first) >= MIN_COMMON and bool(np.median(moved) < MAX_UNMOVED)


def _never_started(claim: Claim) -> str:
    if not claim.began_in_known_map:
        return (
            "the poses are meaningless: the map was never started, for lack of sideways motion or of texture; begin "
            "with sideways motion, or skip frames with `--start`"
        )
    found, count = np.count_nonzero(claim.tracked), len(claim)
    return (
        f"{found} of {count} frames were found in the known map: they show another place, or the same one from "
        "elsewhere or in another light; there is no trajectory to use"
    )


def bridging_error(claim: Claim) -> float:
    """Return the error that lost frames may have, metres, RMS over all frames."""
    squares = 0.0
    for first, last in spans(~claim.tracked):
        before, after = max(first - 1, 0), min(last + 1, len(claim) - 1)
        seconds = float(claim.times[after] - claim.times[before])
        open_end = first == 0 or last == len(claim) - 1
        error = ACCELERATION * seconds**2 / (2 if open_end else 8)
        squares += (last - first + 1) * error**2 / 2
    return float(np.sqrt(squares / max(len(claim), 1)))
