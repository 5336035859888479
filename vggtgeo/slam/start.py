"""Initialisation without depth in the first keyframe: from a later frame with depth, or from two views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.models.classical import NoDepth
from vggtgeo.models.roles import Features, GeometryResult, PointMatches, StartGuess
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe, make_keyframe
from vggtgeo.slam.sparse_map.units import NOMINAL_DEPTH
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.track import FrameData, TrackingInput, track
from vggtgeo.slam.tracking.tracker import MAX_UNPLACED, FramePose, UnplacedFrame, given_up
from vggtgeo.slam.window.sliding_window import scale_anchor
from vggtgeo.slam.window_steps import adjust_window, insert_keyframe

MIN_SHARED = 100
"""Matches that a waiting frame must share with the current one to start the map instead of the first keyframe:
`TwoViewStart` needs 60 inliers. The initialiser of ORB-SLAM (Mur-Artal, Montiel, Tardos, 2015) changes its reference
below the same number."""


def without_depth(roles: Roles) -> Roles:
    """Return the same roles without metric depth, which would contradict the scale of a map that was started without
    it.
    """
    return replace(roles, depth=NoDepth()) if roles.metric else roles


def begin_again_with_depth(
    slam: Slam, frame: Frame, features: Features, roles: Roles, settings: SlamSettings
) -> Slam | None:
    """Return the state of a map that starts at this frame instead of the first keyframe, whose depth is unknown.

    None if this frame has depth at fewer than `min_inliers` key points.
    """
    depth = roles.depth.estimate(frame.image, frame.depth, tuple(slam.intrinsics))
    if not np.any(np.isfinite(depth.depth)):
        return None
    blind = slam.keyframes[slam.window.members[-1]]
    keyframe = make_keyframe(
        blind.number, frame, blind.pose, Description.of(features), roles, settings, slam.intrinsics
    )
    if np.count_nonzero(np.isfinite(keyframe.points.inverse_depth)) < settings.keyframes.min_inliers:
        return None
    note = f"the depth of frame {blind.frame} is not known; the map begins at frame {frame.index} ({frame.name})"
    before = tuple(
        replace(record, tracked=False, inliers=0) if record.frame == blind.frame else record for record in slam.frames
    )
    record = FramePose(frame.index, frame.timestamp, blind.number, np.eye(4), True, len(features))
    waiting = (UnplacedFrame(blind.frame, blind.timestamp, blind.image, blind.features), *slam.tracker.waiting)
    slam = replace(
        slam,
        map=replace(slam.map, keyframes=(*slam.keyframes[:-1], keyframe)),
        tracker=replace(slam.tracker, frames=(*before, record), waiting=waiting),
        notes=(*slam.notes, note),
    )
    slam = _place_in_new_map(slam, keyframe, roles)
    return replace(slam, tracker=replace(slam.tracker, waiting=()))


def start_without_depth(slam: Slam, frame: Frame, features: Features, roles: Roles, settings: SlamSettings) -> Slam:
    """Try to start a map without metric depth from the first keyframe and this frame; until then the frame waits.

    A first keyframe that shares nothing with this frame is replaced: a video may start at a wall, or turn away before
    it moves.
    """
    first, matches, guess = _two_views(slam, frame, features, roles)
    if guess.result not in (GeometryResult.SUCCESS, GeometryResult.LOW_PARALLAX, GeometryResult.AMBIGUOUS):
        later = _later_first(slam, features, roles, settings)
        if later is not None:
            slam = later
            first, matches, guess = _two_views(slam, frame, features, roles)
    if guess.result is not GeometryResult.SUCCESS:
        return _wait(slam, frame, features)
    if slam.metric:
        note = (
            f"neither frame {first.frame} nor frame {frame.index} has metric depth: "
            "the scale is free from here on, and later depth is not used"
        )
        slam, roles = (
            replace(slam, map=replace(slam.map, metric=False), notes=(*slam.notes, note)),
            without_depth(roles),
        )
    scale = NOMINAL_DEPTH / float(np.median(guess.points[guess.inliers, 2]))
    relative = guess.pose.copy()
    relative[:3, 3] *= scale
    inverse = np.full(len(first.features), np.nan)
    inverse[matches.index_i[guess.inliers]] = 1.0 / (scale * guess.points[guess.inliers, 2])
    first = replace(first, points=replace(first.points, inverse_depth=inverse))
    keyframes = (*slam.keyframes[:-1], first)
    slam = replace(slam, map=replace(slam.map, keyframes=keyframes))
    number = len(keyframes)
    second = make_keyframe(
        number, frame, relative @ first.pose, Description.of(features), roles, settings, slam.intrinsics
    )
    slam = insert_keyframe(slam, second, roles, settings)
    anchor = scale_anchor(slam.map, slam.window.members)
    slam = adjust_window(replace(slam, map=replace(slam.map, factors=(*slam.map.factors, anchor))), settings)
    first, second = slam.keyframes[first.number], slam.keyframes[number]
    slam = _place_in_new_map(slam, first, roles)
    inliers = int(np.count_nonzero(guess.inliers))
    # The frames between were placed in the map of this moment: what becomes of it later is shared out over them.
    arrival = (first.number, second.pose @ rigid.invert(first.pose))
    record = FramePose(frame.index, frame.timestamp, number, np.eye(4), True, inliers, arrival=arrival)
    return replace(slam, tracker=replace(slam.tracker, frames=(*slam.frames, record), waiting=()))


def _two_views(slam: Slam, frame: Frame, features: Features, roles: Roles) -> tuple[Keyframe, PointMatches, StartGuess]:
    """Return the first keyframe, its matches with the frame, and the estimated motion and structure of both."""
    first = slam.keyframes[slam.window.members[-1]]
    matches = roles.points.match(first.features, features)
    guess = roles.geometry.start(matches.pixels_i, matches.pixels_j, slam.intrinsics, (first.image, frame.image))
    return first, matches, guess


def _later_first(slam: Slam, features: Features, roles: Roles, settings: SlamSettings) -> Slam | None:
    """Return the state whose map will start at the oldest waiting frame with enough matches with the current one.

    All frames after it must have as many. None if the last one has not: the current one may be blurred or dark.
    """
    chosen, old = None, slam.keyframes[slam.window.members[-1]]
    for waiting in reversed(slam.tracker.waiting):
        if waiting.frame < old.frame or len(roles.points.match(waiting.features, features)) < MIN_SHARED:
            break
        chosen = waiting
    if chosen is None:
        return None
    frame = Frame(chosen.frame, chosen.timestamp, chosen.image, chosen.depth, "")
    first = make_keyframe(
        old.number, frame, old.pose, Description.of(chosen.features), roles, settings, slam.intrinsics
    )
    began = FramePose(chosen.frame, chosen.timestamp, old.number, np.eye(4), True, len(chosen.features))
    records = (
        began
        if record.frame == chosen.frame
        else replace(record, tracked=False, inliers=0)
        if record.frame == old.frame
        else record
        for record in slam.frames
    )
    others = tuple(waiting for waiting in slam.tracker.waiting if waiting.frame != chosen.frame)
    back = UnplacedFrame(old.frame, old.timestamp, old.image, old.features)
    return replace(
        slam,
        map=replace(slam.map, keyframes=(*slam.keyframes[:-1], first)),
        tracker=replace(slam.tracker, frames=tuple(records), waiting=(back, *others)[-MAX_UNPLACED:]),
    )


def _wait(slam: Slam, frame: Frame, features: Features) -> Slam:
    waiting = (*slam.tracker.waiting, UnplacedFrame(frame.index, frame.timestamp, frame.image, features))
    record = FramePose(frame.index, frame.timestamp, slam.window.members[-1], np.eye(4), False, 0)
    return replace(slam, tracker=replace(slam.tracker, waiting=waiting[-MAX_UNPLACED:], frames=(*slam.frames, record)))


def _place_in_new_map(slam: Slam, first: Keyframe, roles: Roles) -> Slam:
    """Track the waiting frames in the new map, and keep the accepted poses."""
    placed = {}
    for waiting in slam.tracker.waiting:
        frame = Frame(waiting.frame, waiting.timestamp, waiting.image, waiting.depth, "")
        data = FrameData(frame, Description.of(waiting.features), None)
        found = track(TrackingInput(data, slam.intrinsics, roles), first, None)
        if found.accepted:
            evidence = found.evidence
            record = FramePose(
                *(frame.index, frame.timestamp, first.number, found.relative, True, evidence.inliers, evidence)
            )
            placed[frame.index] = replace(record, seen=found.seen)
    frames = tuple(placed.get(record.frame, record) for record in slam.frames)
    left = () if slam.metric else (waiting for waiting in slam.tracker.waiting if waiting.frame not in placed)
    return replace(slam, tracker=replace(slam.tracker, frames=frames, unplaced=given_up(slam.tracker, left)))
