"""The fold: `step(slam, frame) -> slam`. Nothing here reads or writes a file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.models.roles import Features
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.global_map.joining import join_submaps
from vggtgeo.slam.keyframe_decision import becomes_keyframe, track_by_old_keyframe, view_change
from vggtgeo.slam.local_mapping import (
    adjust_window,
    begin_window,
    insert_keyframe,
    is_due,
    merge_pending_window,
    window_around,
)
from vggtgeo.slam.manhattan import constrain_rotation
from vggtgeo.slam.map_initialisation import (
    begin_again_with_depth,
    start_without_depth,
    without_depth,
)
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.pose_prior import RecordedPrior, recorded_prior
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.covisibility import without_matches
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe, find_lines, make_keyframe
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.frame_refinement import against_reference, with_view
from vggtgeo.slam.tracking.frame_tracking import (
    FrameData,
    MotionPrior,
    TrackedFrame,
    TrackingInput,
    factor_to,
    frame_data,
    moved_with,
    record_of,
    refined_by_map,
    track,
    track_by_map,
    track_by_two_view,
    unless_contradicted,
    view_of,
)
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality
from vggtgeo.slam.tracking.relocalisation import relocalise
from vggtgeo.slam.tracking.tracking_state import FramePose
from vggtgeo.slam.tracking.two_view_motion import usual_step
from vggtgeo.slam.tracking.waiting_frames import begins_submap, place_waiting, wait


def begin(camera: Camera, roles: Roles) -> Slam:
    """Return the state before the first frame."""
    return Slam(Map(roles.metric), CameraEstimate.of(camera))


@in_double_precision
def step(
    slam: Slam, frame: Frame, description: Description, roles: Roles, settings: SlamSettings, clock: Clock | None = None
) -> Slam:
    """Take one frame (undistorted) into the state; its key points are found if they are needed."""
    clock = clock or Clock()
    if is_due(slam):
        slam = _merge_pending_window(slam, clock)
    if not slam.metric:
        roles = without_depth(roles)
    if not slam.keyframes:
        return _first(slam, frame, description.features, roles, settings)
    if not _only_localises(slam) and not _started(slam):
        with clock.measure("start"):
            features = description.features
            begun = begin_again_with_depth(slam, frame, features, roles, settings) if slam.metric else None
            return begun or start_without_depth(slam, frame, features, roles, settings)

    recorded = recorded_prior(slam, roles)
    slam, data, found = _track(slam, frame, description, recorded, roles, settings, clock)
    if found is None or not found.accepted:
        return _handle_lost_frame(
            slam, data, TrackingQuality() if found is None else found.quality, recorded, roles, settings, clock
        )
    was_lost = bool(slam.tracker.lost)
    slam = _moved(slam, frame, found)

    slam, found, inserts = _decide(slam, data, found, roles, settings, clock)
    if inserts:
        slam = _insert_and_adjust(slam, data, found, recorded, roles, settings, clock)
    else:
        slam = _refer_to(slam, found.keyframe, roles)
        slam = _with_record(slam, record_of(frame, found))
        slam = replace(slam, tracker=with_view(slam.map, slam.tracker, data.view, slam.intrinsics, roles))
    return _place_waiting(slam, roles) if was_lost else slam


def _merge_pending_window(slam: Slam, clock: Clock) -> Slam:
    with clock.measure("wait for the window"):
        return merge_pending_window(slam)


def _started(slam: Slam) -> bool:
    """Return whether there is a map to track in; a later keyframe may lack depth, since its neighbours have some."""
    return len(slam.window.members) > 1 or bool(
        np.any(np.isfinite(slam.keyframes[slam.window.members[-1]].points.inverse_depth))
    )


def _only_localises(slam: Slam) -> bool:
    """Return whether this run still only localises in a map of an earlier run.

    None of its own frames has become a keyframe.
    """
    return not slam.window.members


def _first(slam: Slam, frame: Frame, features: Features, roles: Roles, settings: SlamSettings) -> Slam:
    """Begin a map at this frame: at the world's origin, or where tracking was lost."""
    number = len(slam.keyframes)
    keyframe = make_keyframe(number, frame, slam.last_pose, Description.of(features), roles, settings, slam.intrinsics)
    record = FramePose(frame.index, frame.timestamp, number, np.eye(4), True, len(features))
    return replace(
        slam,
        map=replace(slam.map, keyframes=(*slam.keyframes, keyframe), roots=(*slam.map.roots, number), axes=()),
        window=replace(slam.window, members=(number,), prior=None, solved=None, fixed=()),
        tracker=replace(slam.tracker, frames=(*slam.frames, record), velocity=np.eye(4), reference=None, lost=0),
    )


def _track(
    slam: Slam,
    frame: Frame,
    description: Description,
    recorded: RecordedPrior | None,
    roles: Roles,
    settings: SlamSettings,
    clock: Clock,
) -> tuple[Slam, FrameData, TrackedFrame | None]:
    """Track a frame in the map; return the state that the pose belongs to, the frame's data and the track.

    A pending window is taken up first where the frame has no pose, or becomes a keyframe.
    """
    with clock.measure("track"):
        data = frame_data(frame, description, slam.intrinsics, roles, slam.metric)
        data = replace(data, find_lines=lambda: find_lines(frame.image, roles, settings))
        # In a map of another run the place of the first frame is unknown: it is searched by appearance alone.
        unknown_place = _only_localises(slam) and slam.tracker.reference is None
        found = None if unknown_place else _find(slam, data, recorded, roles, settings)
    if slam.pending is not None and (found is None or not found.accepted):
        slam = _merge_pending_window(slam, clock)
        with clock.measure("track"):
            found = _find(slam, data, recorded, roles, settings)
    if slam.pending is not None and found is not None and becomes_keyframe(slam, found, settings.keyframes):
        slam = _merge_pending_window(slam, clock)
        found = moved_with(found, slam.keyframes[found.keyframe.number])
    if (slam.tracker.lost or not slam.metric) and (found is None or not found.accepted):
        with clock.measure("relocalise"):
            found = relocalise(TrackingInput(data, slam.intrinsics, roles), slam.keyframes, slam.tracker) or found
    grows = bool(slam.window.members) and not settings.keyframes.localise_only
    if grows and not slam.metric and found is not None:
        with clock.measure("track"):
            newest = slam.keyframes[slam.window.members[-1]]
            given = TrackingInput(data, slam.intrinsics, roles, _prior(slam, frame, recorded))
            length = None if recorded is None else recorded.length(newest, frame.timestamp)
            length = length or usual_step(slam.keyframes, frame.index)
            if found.accepted:
                found = unless_contradicted(found, given, newest, length)
            else:
                found = track_by_two_view(given, newest, length) or found
    return slam, data, found


def _moved(slam: Slam, frame: Frame, found: TrackedFrame) -> Slam:
    """Set the motion to a tracked frame; it is unknown after tracking was lost."""
    if slam.tracker.lost:
        slam = _noted_found(slam, frame)
        velocity = np.eye(4)
    else:
        velocity = found.pose @ rigid.invert(slam.last_pose)
    return slam.with_tracker(velocity=velocity, lost=0)


def _decide(
    slam: Slam, data: FrameData, found: TrackedFrame, roles: Roles, settings: SlamSettings, clock: Clock
) -> tuple[Slam, TrackedFrame, bool]:
    """Decide whether a tracked frame becomes a keyframe.

    It does not where an old keyframe shows it as well; that one is then its keyframe.
    """
    if becomes_keyframe(slam, found, settings.keyframes):
        with clock.measure("track"):
            tied, found = track_by_old_keyframe(slam, data, found, roles, settings)
            slam = slam if settings.keyframes.localise_only else tied
    return slam, found, not settings.keyframes.localise_only and becomes_keyframe(slam, found, settings.keyframes)


def _find(
    slam: Slam, data: FrameData, recorded: RecordedPrior | None, roles: Roles, settings: SlamSettings
) -> TrackedFrame:
    """Track a frame against the reference, or against another keyframe that sees more of it."""
    prior = _prior(slam, data.frame, recorded)
    first = slam.tracker.reference[0] if slam.tracker.reference is not None else slam.window.members[-1]
    others = [number for number in reversed(slam.window.members) if number != first][:2]
    window = tuple(slam.keyframes[number] for number in (first, *others))
    given = TrackingInput(data, slam.intrinsics, roles, prior, window)
    best: TrackedFrame | None = None
    for keyframe in window:
        found = track(given, keyframe, view_of(keyframe, slam.tracker, slam.intrinsics, roles))
        if best is None or _rank(found) > _rank(best):
            best = found
        if best.accepted and (best.quality.inliers >= settings.keyframes.min_inliers or best.quality.dense_strong):
            break
    assert best is not None
    # A frame that flow has placed is not described for the sake of points that other keyframes see, too.
    if best.accepted and not data.description.described:
        return best
    submap = slam.keyframes[slam.map.roots[-1] :]
    if not best.accepted:
        source = view_of(best.keyframe, slam.tracker, slam.intrinsics, roles)
        joint = track_by_map(given, submap, best.keyframe, source)
        return replace(joint, matches=best.matches) if joint.accepted else best
    return refined_by_map(best, given, submap)


def _prior(slam: Slam, frame: Frame, recorded: RecordedPrior | None) -> MotionPrior:
    """Predict a frame's pose from the recording, or by constant velocity."""
    step = None if recorded is None else recorded.step(slam, frame.timestamp)
    velocity = slam.tracker.velocity if step is None else step
    predicted = rigid.orthonormal(velocity @ slam.last_pose)
    return MotionPrior(predicted, velocity, slam.tracker.lost)


def _rank(found: TrackedFrame) -> tuple[bool, int]:
    return found.accepted, found.quality.inliers


def _insert_and_adjust(
    slam: Slam,
    data: FrameData,
    found: TrackedFrame,
    recorded: RecordedPrior | None,
    roles: Roles,
    settings: SlamSettings,
    clock: Clock,
) -> Slam:
    """Insert the frame as a keyframe, match it and adjust the window.

    Beside tracking where the keyframe's own depth places the next frames, and where there is one submap only.
    """
    frame, number = data.frame, len(slam.keyframes)
    with clock.measure("keyframe"):
        keyframe = make_keyframe(
            number, frame, found.pose, data.description, roles, settings, slam.intrinsics, data.found_lines
        )
    arrival, inliers = (found.keyframe.number, found.relative), found.quality.inliers
    record = FramePose(frame.index, frame.timestamp, number, np.eye(4), True, inliers, found.quality, arrival)
    odometry = factor_to(found, number)
    if odometry.first not in slam.window.members:
        slam = window_around(slam, odometry.first, settings)
    slam = slam.with_tracker(reference=(number, data.view))

    # From `slam`, in which the new keyframe is not yet inserted: its thread inserts it with its matches.
    def adjusted(own: str) -> Slam:
        with clock.measure("match keyframes" + own):
            measured = not found.quality.by_two_view
            entered = insert_keyframe(slam, keyframe, roles, settings, tied_to=odometry.first, length_known=measured)
            entered = _with_odometry(entered, odometry)
            entered = entered if recorded is None else recorded.with_factor(entered)
            entered = constrain_rotation(entered, settings)
        with clock.measure("place frames" + own):
            entered = replace(entered, tracker=against_reference(entered.map, entered.tracker))
        with clock.measure("adjust window" + own):
            return adjust_window(entered, settings)

    if slam.metric and len(slam.map.roots) == 1:
        inserted = replace(
            slam,
            map=replace(slam.map, keyframes=(*slam.keyframes, keyframe), factors=(*slam.map.factors, odometry)),
            tracker=replace(slam.tracker, between=()),
            window=replace(slam.window, members=(*slam.window.members, number)),
        )
        return _with_record(begin_window(inserted, lambda: adjusted(" (own thread)")), record)
    slam = adjusted("")
    with clock.measure("relocalise"):
        return _with_record(join_submaps(slam, data, roles, settings), record)


def _with_record(slam: Slam, record: FramePose) -> Slam:
    return slam.with_tracker(frames=(*slam.frames, record))


def _with_odometry(slam: Slam, odometry: MeasuredRelativePose) -> Slam:
    """Add an odometry factor, and a pair without a match if its keyframes have none.

    So the last adjustment aligns the surfaces of both.
    """
    known = replace(slam.map, factors=(*slam.map.factors, odometry))
    if all(pair.key != odometry.keyframes for pair in known.pairs):
        known = replace(known, pairs=(*known.pairs, without_matches(*odometry.keyframes)))
    return replace(slam, map=known)


def _refer_to(slam: Slam, keyframe: Keyframe, roles: Roles) -> Slam:
    if slam.tracker.reference is not None and slam.tracker.reference[0] == keyframe.number:
        return slam
    reference = keyframe.number, view_of(keyframe, slam.tracker, slam.intrinsics, roles)
    return replace(slam, tracker=against_reference(slam.map, replace(slam.tracker, reference=reference)))


def _place_waiting(slam: Slam, roles: Roles) -> Slam:
    return replace(slam, tracker=place_waiting(slam.map, slam.tracker, slam.intrinsics, roles))


def _noted_found(slam: Slam, frame: Frame) -> Slam:
    note = f"found again at frame {frame.index} ({frame.name}), {slam.tracker.lost} frames after tracking was lost"
    if _only_localises(slam) and slam.tracker.reference is None:
        note = f"frame {frame.index} ({frame.name}) is the first that was found in the map"
    return replace(slam, notes=(*slam.notes, note))


def _handle_lost_frame(
    slam: Slam,
    data: FrameData,
    quality: TrackingQuality,
    recorded: RecordedPrior | None,
    roles: Roles,
    settings: SlamSettings,
    clock: Clock,
) -> Slam:
    """Give a frame that images do not place its recorded pose, if known; else let it wait, or begin a submap at it."""
    frame, features = data.frame, data.features
    carried = None if recorded is None else recorded.carried(slam, frame.timestamp)
    if carried is not None:
        slam = _moved(slam, frame, carried)
        shows = len(features) > settings.keyframes.min_inliers
        moved = view_change(slam, carried.pose, slam.keyframes[-1], settings.keyframes) > 1.0
        if settings.keyframes.localise_only or not (shows and moved):
            return _with_record(slam, record_of(frame, carried))
        return _insert_and_adjust(slam, data, carried, recorded, roles, settings, clock)
    if slam.tracker.lost == 0:
        slam = slam.with_notes(f"tracking was lost at frame {frame.index} ({frame.name})")
    lost = replace(slam, tracker=wait(slam.tracker, frame, features, quality))
    if not begins_submap(lost.tracker, features, settings.keyframes):
        return lost
    note = (
        f"a new submap begins at frame {frame.index} ({frame.name}): "
        "nothing connects it to the one before, its place is only a guess"
    )
    begun = _first(slam.with_notes(note), frame, features, roles, settings)
    return _place_waiting(begun, roles) if _started(begun) else begun
