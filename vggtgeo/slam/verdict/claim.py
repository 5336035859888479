"""What a run claims, and the corner tracks of windows of its frames that test it, as arrays for the adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import MIN_KEYFRAMES_FOR_CAMERA, Readout
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.slam.verdict.corner_recorder import CornerTracks
from vggtgeo.slam.verdict.thresholds import MAX_PLACE_ERROR, MAX_PLACE_ERROR_SHARE, MIN_COMMON, MIN_VIEWS

WINDOW, SHARED, MAX_STEP = 24, 0.5, 3
"""Frames that are adjusted together. The next frame of a window is the farthest one that still shows this share of the
corners, at most so many on."""
KNOTS = 4
"""Of a quantity that changes with time: linear between so many moments, evenly spread over the window."""


@dataclass(frozen=True, eq=False)
class Claim:
    """The claim of a run. frames: int [n]. times: float64 [n], s. poses: float64 [n, 4, 4], world -> camera. tracked:
    bool [n]. intrinsics: fx, fy, cx, cy, pixels. metric: lengths are metres. submaps: their number. started: there was
    a map. began_in_known_map: the run began in the map of an earlier one. guessed: the camera is unknown, and too
    little was seen to estimate it. readout: of the rolling shutter that the last adjustment found.
    """

    frames: np.ndarray
    times: np.ndarray
    poses: np.ndarray
    tracked: np.ndarray
    intrinsics: np.ndarray
    metric: bool
    submaps: int = 1
    started: bool = True
    began_in_known_map: bool = False
    guessed: bool = False
    readout: Readout | None = None

    @classmethod
    def of(cls, slam: Slam) -> Self:
        times, poses = frame_poses(slam)
        known = slam.camera.calibrated or slam.camera.self_calibrated
        return cls(
            frames=np.array([record.frame for record in slam.frames], int),
            times=times,
            poses=poses,
            tracked=np.array([record.tracked for record in slam.frames], bool),
            intrinsics=np.asarray(slam.intrinsics, np.float64),
            metric=slam.metric,
            submaps=max(len(submaps_by_size(slam)), 1),
            started=any(np.isfinite(keyframe.points.inverse_depth).any() for keyframe in slam.keyframes),
            began_in_known_map=any(keyframe.frame < 0 for keyframe in slam.keyframes),
            guessed=not known and len(slam.keyframes) < MIN_KEYFRAMES_FOR_CAMERA,
            readout=slam.camera.readout,
        )

    def __len__(self) -> int:
        return len(self.frames)

    def span(self, first: int, last: int) -> tuple[int, int, str]:
        """Return the numbers of the frames in two rows, and a text with them and their times."""
        start, end = int(self.frames[first]), int(self.frames[last])
        return start, end, f"frames {start} to {end} ({self.times[first]:.1f} to {self.times[last]:.1f} s)"


def extent(poses: np.ndarray) -> float:
    """Return the RMS distance of the places from their mean, of poses world -> camera [n, 4, 4], above zero."""
    return max(float(np.sqrt(np.sum(rigid.centres(poses).var(0)))), 1e-12)


def max_place_error(metric: bool, poses: np.ndarray) -> float:
    """Return the largest RMS error of these places that does not matter, in the unit of the map."""
    return MAX_PLACE_ERROR if metric else MAX_PLACE_ERROR_SHARE * extent(poses)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Corner tracks of a few frames, and what the run claims of these. rows: int [f], of the run. times: float64 [f],
    s. poses: float64 [f, 4, 4], world -> camera. intrinsics: fx, fy, cx, cy. size: width, height, pixels. frame, track:
    int [m], of each observation, sorted by track. pixels: float64 [m, 2]. depth: float64 [m], metres, NaN where it was
    not measured or the map is not metric. readout: float64 [m, 2], pixels by which a rolling shutter of one second
    moves the corner.
    """

    rows: np.ndarray
    times: np.ndarray
    poses: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    frame: np.ndarray
    track: np.ndarray
    pixels: np.ndarray
    depth: np.ndarray
    readout: np.ndarray

    @cached_property
    def first(self) -> np.ndarray:
        """First observation of each track, int [t]."""
        return np.flatnonzero(np.r_[True, self.track[1:] != self.track[:-1]])

    @cached_property
    def from_anchor(self) -> np.ndarray:
        """From the camera that the run claims for the track's first frame to the world, float64 [m, 4, 4]."""
        return rigid.invert(self.poses[self.frame[self.first]])[self.track]

    @cached_property
    def depths(self) -> np.ndarray:
        """The number of measured depths of each observation's track, at least 1, float64 [m]."""
        return np.maximum(self.sums(np.isfinite(self.depth).astype(np.float64)), 1.0)[self.track]

    @cached_property
    def knots(self) -> np.ndarray:
        """Weights that interpolate between the knots, of each observation: float64 [m, KNOTS]."""
        span = max(float(self.times[-1] - self.times[0]), 1e-9)
        at = (self.times - self.times[0]) / span * (KNOTS - 1)
        return np.maximum(1.0 - np.abs(at[:, None] - np.arange(KNOTS)), 0.0)[self.frame]

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sum values [m, ...] over the observations of each track: [t, ...]."""
        return np.asarray(np.add.reduceat(values, self.first, axis=0))

    def subset(self, kept: np.ndarray) -> Tracks:
        """Return the tracks of which `kept`, bool [t], is true."""
        rows = kept[self.track]
        parts = {name: getattr(self, name)[rows] for name in ("frame", "pixels", "depth", "readout")}
        return replace(self, **parts, track=(np.cumsum(kept) - 1)[self.track[rows]])


def linked(evidence: CornerTracks, tracked: np.ndarray) -> list[np.ndarray]:
    """Split tracked frames into stretches, each linked to the next frame by corners: rows, increasing."""
    rows = np.flatnonzero(tracked)
    apart = [len(evidence[row].common(evidence[after])[0]) < MIN_COMMON for row, after in pairwise(rows.tolist())]
    return np.split(rows, np.flatnonzero(apart) + 1) if len(rows) else []


def thinned(evidence: CornerTracks, rows: np.ndarray) -> np.ndarray:
    """Select the frames of a stretch between which corners move enough, first and last included."""
    chosen, last = [0], len(rows) - 1
    while chosen[-1] < last:
        here, place = evidence[rows[chosen[-1]]], chosen[-1] + 1
        needed = max(SHARED * len(here.ids), MIN_COMMON)
        furthest = min(chosen[-1] + MAX_STEP, last)
        while place < furthest and len(here.common(evidence[rows[place + 1]])[0]) >= needed:
            place += 1
        chosen.append(place)
    return rows[chosen]


def windows(rows: np.ndarray) -> list[np.ndarray]:
    """Return windows of at most `WINDOW` of these rows, evenly spread, that overlap by a third at least."""
    last = max(len(rows) - WINDOW, 0)
    starts = np.linspace(0, last, int(np.ceil(last / (WINDOW * 2 / 3))) + 1).astype(int)
    return [rows[start : start + WINDOW] for start in starts]


def tracks_of_windows(claim: Claim, evidence: CornerTracks, size: tuple[int, int]) -> list[Tracks]:
    """Return the corner tracks of each window of a run; evidence: of its frames; size: of its images."""
    rows = (rows for stretch in linked(evidence, claim.tracked) for rows in windows(thinned(evidence, stretch)))
    found = (tracks_of(claim, evidence, some, size) for some in rows)
    return [tracks for tracks in found if tracks is not None]


def tracks_of(claim: Claim, evidence: CornerTracks, rows: np.ndarray, size: tuple[int, int]) -> Tracks | None:
    """Return the tracks that at least `MIN_VIEWS` of these frames, int [f], increasing, see; None without any."""
    seen = [evidence[row] for row in rows]
    ids, pixels, depth = (np.concatenate([getattr(one, name) for one in seen]) for name in ("ids", "pixels", "depth"))
    frame = np.repeat(np.arange(len(rows)), [len(one.ids) for one in seen])
    velocity = np.concatenate([_velocities(evidence, int(row)) for row in rows])
    _, track, views = np.unique(ids, return_inverse=True, return_counts=True)
    order = np.argsort(ids, kind="stable")  # by track, then by frame
    kept = order[views[track[order]] >= MIN_VIEWS]
    if not len(kept):
        return None
    pixels, depth = pixels[kept].astype(np.float64), depth[kept].astype(np.float64)
    rolling = claim.readout or Readout(0.0, columns=False, shift=0.0)
    axis = 0 if rolling.columns else 1
    readout = (pixels[:, [axis]] / size[axis] - 0.5) * velocity[kept]
    pixels = pixels - rolling.seconds * readout
    depth = np.where((depth > 0) & claim.metric, depth, np.nan)
    track = np.unique(ids[kept], return_inverse=True)[1]
    times, poses, intrinsics = claim.times[rows], claim.poses[rows], np.asarray(claim.intrinsics, np.float64)
    return Tracks(rows, times, poses, intrinsics, size, frame[kept], track, pixels, depth, readout)


def _velocities(evidence: CornerTracks, row: int) -> np.ndarray:
    """Return the velocity of a frame's corners from the frames before and after, pixels a second."""
    here = evidence[row]
    moved, seconds = np.zeros(here.pixels.shape), np.zeros(len(here.ids))
    for sign, there in ((-1.0, evidence[max(row - 1, 0)]), (1.0, evidence[min(row + 1, len(evidence) - 1)])):
        own, theirs = here.common(there)
        moved[own] += sign * (there.pixels[theirs] - here.pixels[own])
        seconds[own] += abs(there.timestamp - here.timestamp)
    return np.asarray(moved / np.maximum(seconds, 1e-6)[:, None])
