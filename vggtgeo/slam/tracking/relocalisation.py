"""Relocalization: candidates by appearance, verified by geometry; accepted on strict evidence only."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import POSE_GATE
from vggtgeo.models.classical import global_descriptor
from vggtgeo.models.roles import Features
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.tracking.accumulated_odometry import Odometry
from vggtgeo.slam.tracking.frame_tracking import TrackedFrame, TrackingInput, factor_between, track, view_of
from vggtgeo.slam.tracking.tracking_state import Tracker

CANDIDATES = 5
"""Keyframes that are verified by geometry for one frame; each costs about as much as a tracked frame."""
MAX_DRIFT = 0.05
"""Largest drift of a place relative to the way since, for loops that are searched during the run; RGB-D tracking alone
drifts by 1 to 2 %."""


def relocalise(
    given: TrackingInput, candidates: Iterable[Keyframe], tracker: Tracker, most: int = CANDIDATES
) -> TrackedFrame | None:
    """Return the frame's pose by the most similar of `candidates`, if one of the first `most` is certain."""
    for keyframe in most_similar(given.data.features, tuple(candidates))[:most]:
        found = track(given, keyframe, view_of(keyframe, tracker, given.intrinsics, given.roles))
        if found.quality.certain:
            return found
    return None


def close_loop_while_tracking(
    given: TrackingInput, current: TrackedFrame, known: Map, tracker: Tracker, members: Sequence[int]
) -> TrackedFrame | None:
    """Return the frame's pose by an old keyframe of the same place, whatever the drift: a loop closed during the run.

    Tracking continues from there, and the last adjustment distributes the error of the loop. At most one keyframe is
    verified, since that costs as much as tracking a frame: one as similar to the frame as those of the window, and
    within the possible drift. A place that contradicts odometry only looks the same. Without metric depth the scale
    drifts too, and loops are closed at the end.

    current: the frame's track by the current estimate. members: of the window.
    """
    recent = members[0] if members else 0
    centres = np.array([rigid.centre(keyframe.pose) for keyframe in known.keyframes])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    way = np.append(np.cumsum(steps[::-1])[::-1], 0.0)  # from each keyframe to the newest
    within = np.linalg.norm(centres - rigid.centre(current.pose), axis=1) < MAX_DRIFT * way
    old = [k for k in known.keyframes[:recent] if k.global_descriptor is not None and within[k.number]]
    own = global_descriptor(given.data.features) if known.metric and old else None
    if own is None:
        return None
    near = [known.keyframes[number].global_descriptor for number in members]
    # Similarity has no absolute scale: plain rooms resemble each other more than furnished ones.
    usual = np.median([other @ own for other in near if other is not None] or [1.0])
    similarity = [float(k.global_descriptor @ own) for k in old if k.global_descriptor is not None]
    best = int(np.argmax(similarity))
    if similarity[best] < usual:
        return None
    found = track(given, old[best], view_of(old[best], tracker, given.intrinsics, given.roles))
    if not (found.accepted and found.quality.certain):
        return None
    # Rooms that look the same pass the check by points; odometry bounds how far drift can have moved the camera.
    odometry = Odometry.of(known.odometry_factors, len(known.keyframes))
    return None if odometry.distances([factor_between(current, found)])[0] >= POSE_GATE else found


def most_similar(features: Features, keyframes: Sequence[Keyframe]) -> tuple[Keyframe, ...]:
    """Return the most similar keyframes, best first; the newest without descriptors."""
    own = global_descriptor(features)
    known = [keyframe for keyframe in keyframes if keyframe.global_descriptor is not None]
    if own is None or not known:
        return tuple(reversed(keyframes[-CANDIDATES:]))
    similarity = np.array([keyframe.global_descriptor @ own for keyframe in known])
    return tuple(known[i] for i in np.argsort(-similarity, kind="stable")[:CANDIDATES])
