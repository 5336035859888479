"""Relocalization: candidates by appearance, verified by geometry; accepted on strict evidence only."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.models.classical import place_vector
from vggtgeo.models.roles import Features
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.tracking.evidence import STEP_GATE
from vggtgeo.slam.tracking.odometry import Odometry
from vggtgeo.slam.tracking.track import FrameData, Track, TrackingInput, tie_between, track
from vggtgeo.slam.tracking.tracking_state import FramePose, Tracker

CANDIDATES = 5
"""Keyframes that are verified by geometry for one frame; each costs about as much as a tracked frame."""
MAX_DRIFT = 0.05
"""Largest drift of a place relative to the way since, for loops that are searched during the run; RGB-D tracking alone
drifts by 1 to 2 %."""


def relocalise(
    given: TrackingInput, candidates: Iterable[Keyframe], tracker: Tracker, most: int = CANDIDATES
) -> Track | None:
    """Return the frame's pose by the most similar of `candidates`, if one of the first `most` is certain."""
    for keyframe in most_similar(given.data.features, tuple(candidates))[:most]:
        found = track(given, keyframe, view_of(keyframe, tracker, given.intrinsics, given.roles))
        if found.evidence.certain:
            return found
    return None


def close_loop_while_tracking(
    given: TrackingInput, current: Track, known: Map, tracker: Tracker, members: Sequence[int]
) -> Track | None:
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
    old = [k for k in known.keyframes[:recent] if k.place is not None and within[k.number]]
    place = place_vector(given.data.features) if known.metric and old else None
    if place is None:
        return None
    near = [known.keyframes[number].place for number in members]
    # Similarity has no absolute scale: plain rooms resemble each other more than furnished ones.
    usual = np.median([other @ place for other in near if other is not None] or [1.0])
    similarity = [float(k.place @ place) for k in old if k.place is not None]
    best = int(np.argmax(similarity))
    if similarity[best] < usual:
        return None
    found = track(given, old[best], view_of(old[best], tracker, given.intrinsics, given.roles))
    if not (found.accepted and found.evidence.certain):
        return None
    # Rooms that look the same pass the check by points; odometry bounds how far drift can have moved the camera.
    odometry = Odometry.of(known.odometry_factors, len(known.keyframes))
    return None if odometry.distances([tie_between(current, found)])[0] >= STEP_GATE else found


def most_similar(features: Features, keyframes: Sequence[Keyframe]) -> tuple[Keyframe, ...]:
    """Return the most similar keyframes, best first; the newest without descriptors."""
    place = place_vector(features)
    known = [keyframe for keyframe in keyframes if keyframe.place is not None]
    if place is None or not known:
        return tuple(reversed(keyframes[-CANDIDATES:]))
    similarity = np.array([keyframe.place @ place for keyframe in known])
    return tuple(known[i] for i in np.argsort(-similarity, kind="stable")[:CANDIDATES])


def view_of(keyframe: Keyframe, tracker: Tracker, intrinsics: np.ndarray, roles: Roles) -> RgbdView | None:
    """Return a keyframe's view for the alignment: stored for the reference, else computed."""
    if roles.alignment is None:
        return None
    if tracker.reference is not None and tracker.reference[0] == keyframe.number:
        return tracker.reference[1]
    depth = keyframe.depth.astype(np.float32), keyframe.depth_sigma.astype(np.float32)
    return RgbdView.of(keyframe.image, depth, intrinsics)


def frame_data(frame: Frame, description: Description, intrinsics: np.ndarray, roles: Roles, metric: bool) -> FrameData:
    """Return the frame's data for tracking. metric: whether lengths of the map are metres."""
    view = None
    if roles.alignment is not None and metric:
        view = description.view_by(intrinsics)
        view = view or RgbdView.of(frame.image, roles.tracking_depth(frame.depth), intrinsics)
    return FrameData(frame, description, view)


def record_of(frame: Frame, found: Track) -> FramePose:
    """Return the record of a tracked frame relative to its keyframe."""
    return FramePose(
        frame.index,
        frame.timestamp,
        found.keyframe.number,
        found.relative,
        True,
        found.evidence.inliers,
        found.evidence,
        seen=found.seen,
    )
