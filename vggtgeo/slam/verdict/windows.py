"""Corner tracks of windows of frames, as arrays for the adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from vggtgeo.slam.verdict.claim import Claim
from vggtgeo.slam.verdict.corner_adjustment import Tracks
from vggtgeo.slam.verdict.corner_recorder import FrameEvidence
from vggtgeo.slam.verdict.thresholds import MIN_COMMON, MIN_VIEWS

WINDOW = 24
"""Frames that are adjusted together."""
SHARED, MAX_STEP = 0.5, 3
"""The next frame of a window is the farthest one that still shows this share of the corners, at most so many on."""


def common(first: FrameEvidence, second: FrameEvidence) -> int:
    """Count the tracks that both frames saw."""
    return len(np.intersect1d(first.ids, second.ids, assume_unique=True))


def linked(evidence: Sequence[FrameEvidence], tracked: np.ndarray) -> list[np.ndarray]:
    """Split tracked frames into stretches, each linked to the next frame by corners: rows, increasing."""
    rows = np.flatnonzero(tracked)
    if not len(rows):
        return []
    cuts = [
        place + 1
        for place, (row, after) in enumerate(pairwise(rows.tolist()))
        if common(evidence[row], evidence[after]) < MIN_COMMON
    ]
    return np.split(rows, cuts)


def thinned(evidence: Sequence[FrameEvidence], rows: np.ndarray) -> np.ndarray:
    """Select the frames of a stretch between which corners move enough, first and last included."""
    chosen, place = [0], 0
    while place < len(rows) - 1:
        here = evidence[rows[place]]
        farthest = place + 1
        for ahead in range(place + 2, min(place + MAX_STEP, len(rows) - 1) + 1):
            if common(here, evidence[rows[ahead]]) < max(SHARED * len(here.ids), MIN_COMMON):
                break
            farthest = ahead
        chosen.append(farthest)
        place = farthest
    return rows[chosen]


def windows(rows: np.ndarray) -> list[np.ndarray]:
    """Return windows of at most `WINDOW` of these rows, evenly spread, that overlap by a third at least."""
    last = max(len(rows) - WINDOW, 0)
    starts = np.linspace(0, last, int(np.ceil(last / (WINDOW * 2 / 3))) + 1).astype(int)
    return [rows[start : start + WINDOW] for start in starts]


def tracks_of(
    claim: Claim, evidence: Sequence[FrameEvidence], rows: np.ndarray, size: tuple[int, int]
) -> Tracks | None:
    """Return the tracks that at least `MIN_VIEWS` of these frames see; None without any.

    rows: int [f], increasing, of tracked frames.
    """
    seen = [evidence[row] for row in rows]
    ids, pixels, depth = (np.concatenate([getattr(one, name) for one in seen]) for name in ("ids", "pixels", "depth"))
    frame = np.repeat(np.arange(len(rows)), [len(one.ids) for one in seen])
    velocity = np.concatenate([_velocities(evidence, int(row)) for row in rows])
    _, track, views = np.unique(ids, return_inverse=True, return_counts=True)
    kept = np.flatnonzero(views[track] >= MIN_VIEWS)
    if not len(kept):
        return None
    kept = kept[np.lexsort((frame[kept], ids[kept]))]
    pixels = pixels[kept].astype(np.float64)
    axis = 0 if claim.readout is not None and claim.readout.columns else 1
    readout = (pixels[:, [axis]] / size[axis] - 0.5) * velocity[kept]
    if claim.readout is not None:
        pixels = pixels - claim.readout.seconds * readout
    return Tracks(
        rows=rows,
        times=claim.times[rows],
        poses=claim.poses[rows],
        intrinsics=np.asarray(claim.intrinsics, np.float64),
        size=size,
        frame=frame[kept],
        track=np.unique(ids[kept], return_inverse=True)[1],
        pixels=pixels,
        depth=np.where(depth[kept] > 0, depth[kept], np.nan).astype(np.float64) * (1.0 if claim.metric else np.nan),
        readout=readout,
    )


def _velocities(evidence: Sequence[FrameEvidence], row: int) -> np.ndarray:
    """Return the velocity of a frame's corners from the frames before and after, pixels a second."""
    here = evidence[row]
    moved, seconds = np.zeros(here.pixels.shape), np.zeros(len(here.ids))
    for other, sign in ((row - 1, -1.0), (row + 1, 1.0)):
        if 0 <= other < len(evidence):
            there = evidence[other]
            _, own, theirs = np.intersect1d(here.ids, there.ids, assume_unique=True, return_indices=True)
            moved[own] += sign * (there.pixels[theirs] - here.pixels[own])
            seconds[own] += abs(there.timestamp - here.timestamp)
    return np.asarray(moved / np.maximum(seconds, 1e-6)[:, None])
