"""Running the fold over a sequence: reading and describing frames in one thread, tracking and mapping in another."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.datasets.frame import Frame, Sequence, check_frame
from vggtgeo.datasets.views import FrameStream, frame_stream, reduced
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_kind, check_whole
from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.models.classical import NoDepth
from vggtgeo.models.roles import Features
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.global_map.global_adjustment import ROUNDS, adjust_all
from vggtgeo.slam.global_map.joining import join_at_end
from vggtgeo.slam.global_map.loops import close_loops
from vggtgeo.slam.global_map.lost_frame_recovery import place_lost_without_depth
from vggtgeo.slam.known_map import entered
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.pipeline import begin, step
from vggtgeo.slam.pose_prior import with_recorded_factors
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings, check_answer
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.slam.threads import prefetched
from vggtgeo.slam.tracking.frame_refinement import against_nearest

AHEAD = 3
"""Frames that are prepared before they are needed."""
WaitContext = Callable[[], AbstractContextManager[Any]]
"""Makes a context that is entered while the run waits for a frame."""


def run(
    frames: Sequence | Iterable[Any],
    roles: Roles | None = None,
    settings: SlamSettings | None = None,
    *,
    camera: Camera | None = None,
    start: int = 0,
    end: int | None = None,
    stride: int = 1,
    clock: Clock | None = None,
    known_map: Slam | None = None,
) -> Iterator[Slam]:
    """Track and map; yields the state after every frame, so that a caller can draw, stop or save.

    Args:
        frames: a sequence (`vggtgeo.read`, `vggtgeo.simulate`), or any iterable of `Frame`, of images uint8 [H, W, 3]
            RGB, or of pairs of an image and depth (float [H, W], metres, NaN = none).
        roles: perception objects; by default the classical ones, without depth where the frames have none.
        settings: of the pipeline.
        camera: of an iterable's frames; by default a guess, which is then estimated. A sequence has its own.
        start: first frame.
        end: frame to stop before.
        stride: take every n-th frame.
        clock: adds up seconds by stage.
        known_map: what `vggtgeo.load_map` gave, or a state of another run; the frames are placed in it, and extend it.

    Yields:
        The state: poses are world -> camera, lengths metres where `metric`. The newest keyframe's window is adjusted
        beside tracking, and its result is in the state a few frames later. `vggtgeo.finish` adjusts the last one as a
        whole, `vggtgeo.Result.of` makes trajectory and map of one.

    Example:
        >>> import vggtgeo as vg
        >>> next(vg.run(vg.simulate("room", 3, size=(160, 120))))
        Slam(1 frame, 1 keyframe, tracking)

    """
    check_run_arguments(roles, settings, camera, known_map)
    source: Sequence | FrameStream = frames if isinstance(frames, Sequence) else frame_stream(frames, camera)
    roles = roles or default_roles(source.has_depth)
    settings, clock = settings or SlamSettings(), clock or Clock()
    source = reduced(source, settings.camera.max_pixels)
    selected = source.frames(start, end, stride)
    known = None if known_map is None else entered(known_map, source.camera, roles.points)
    yield from run_frames(selected, source.camera, roles, settings, clock, known)


def check_run_arguments(roles: Any, settings: Any, camera: Any, known_map: Any) -> None:
    """Raise InputError for an argument of another type, for example a table instead of settings."""
    check_kind("roles", roles, Roles | None, "`vggtgeo.Roles`, or None for the classical ones")
    check_kind("settings", settings, SlamSettings | None, "`vggtgeo.SlamSettings`, or None")
    check_kind(
        "camera", camera, Camera | None, "a `vggtgeo.Camera`, as `vggtgeo.Camera((fx, fy, cx, cy), width, height)`"
    )
    check_kind("known_map", known_map, Slam | None, "what `vggtgeo.load_map` gives, or a state of `vggtgeo.run`")


def default_roles(has_depth: bool) -> Roles:
    """Return the classical roles, for frames with or without depth."""
    return Roles() if has_depth else Roles(depth=NoDepth())


def run_frames(
    frames: Iterable[Frame],
    camera: Camera,
    roles: Roles,
    settings: SlamSettings,
    clock: Clock,
    known: Slam | None = None,
    before: Collection[Frame] = (),
    waiting: WaitContext = nullcontext,
) -> Iterator[Slam]:
    """As `run`, for an iterable of frames; continue from the state `known`, or begin a new map if it is None.

    before: the last frames of that state; the first depth image is dropped if it repeats theirs (`with_own_depth`).
    waiting: entered while a frame is waited for.
    """
    slam = begin(camera, roles) if known is None else known
    # Frames of a map whose camera's lens was found are as that lens drew them.
    seen_by = slam.camera.lens or camera
    if roles.static_overlay is not None:
        roles = replace(roles, static_overlay=roles.static_overlay.undistorted(seen_by))
    last = slam.frames[-1].timestamp if slam.frames else -math.inf
    source = with_own_depth(in_order(frames, seen_by, last), before)
    for frame, description in _described(source, seen_by, roles, clock, waiting):
        slam = step(slam, frame, description, roles, settings, clock)
        yield slam


@in_double_precision
def finish(
    slam: Slam,
    roles: Roles | None = None,
    settings: SlamSettings | None = None,
    clock: Clock | None = None,
    *,
    rounds: int = ROUNDS,
    uncertainty: bool = True,
) -> Slam:
    """Join what was seen twice, and adjust the whole map once more.

    Args:
        slam: the last state of a run.
        roles: those of the run, by default the default ones.
        settings: those of the run, by default the default ones.
        clock: adds up seconds by stage.
        rounds: adjustments of the map; one is enough for its camera.
        uncertainty: whether to compute the uncertainty of the poses.

    Example:
        >>> import vggtgeo as vg
        >>> vg.finish(next(vg.run(vg.simulate("room", 3, size=(160, 120)))))
        Slam(1 frame, 1 keyframe, tracking)

    """
    check_kind("slam", slam, Slam, "the state that `vggtgeo.run` yields")
    check_whole("rounds", rounds, 1)
    slam, roles, settings = merge_pending_window(slam), roles or default_roles(slam.metric), settings or SlamSettings()
    fixed = settings.keyframes.localise_only or not settings.refinement.global_adjustment
    if fixed or len(slam.keyframes) < 3:  # the window has adjusted two as well as it can be done
        return slam
    clock = clock or Clock()
    with clock.measure("place frames"):
        slam = replace(slam, tracker=against_nearest(slam.map, slam.tracker, slam.intrinsics, roles))
    with clock.measure("loops"):
        slam = place_lost_without_depth(join_at_end(slam, roles), roles, settings)
        # Lost frames that were placed may link submaps that nothing linked before.
        slam = with_recorded_factors(join_at_end(slam, roles), roles)
        slam = close_loops(slam, roles, settings)
    with clock.measure("global adjustment"):
        return adjust_all(slam, settings, rounds=rounds, uncertainty=uncertainty)


def frame_trajectory(slam: Slam, submap: int = 0) -> Trajectory:
    """Return camera -> world of every frame that has a pose in a submap, by default the largest one.

    A frame without one (lost, or before a start) is left out. Submaps are not connected, so that their poses mean
    nothing to each other: each has a trajectory of its own.

    Example:
        >>> import vggtgeo as vg
        >>> vg.frame_trajectory(next(vg.run(vg.simulate("room", 3, size=(160, 120)))))
        Trajectory(1 pose, 0.00 s, path 0.00 m)

    Raises:
        InputError: `slam` is no state of a run, or has no such submap.

    """
    check_kind("slam", slam, Slam, "a state of a run, as `vggtgeo.run` yields it")
    check_whole("submap", submap, maximum=max(len(submaps_by_size(slam)) - 1, 0) if slam.keyframes else 0)
    times, poses = frame_poses(slam)
    own: set[int] = set(submaps_by_size(slam)[submap]) if slam.keyframes else set()
    chosen = np.array([record.tracked and record.reference in own for record in slam.frames], bool)
    return Trajectory(times[chosen], rigid.invert(poses[chosen]))


def keyframe_trajectory(slam: Slam, submap: int = 0) -> Trajectory:
    """Return camera -> world of the keyframes of a submap, by default the largest one."""
    own = [slam.keyframes[number] for number in submaps_by_size(slam)[submap]] if slam.keyframes else []
    # Keyframes of frames that were placed at the end have the last numbers.
    own.sort(key=lambda keyframe: keyframe.timestamp)
    poses = rigid.invert(np.array([keyframe.pose for keyframe in own]).reshape(-1, 4, 4))
    return Trajectory(np.array([keyframe.timestamp for keyframe in own]), poses)


def in_order(frames: Iterable[Frame], camera: Camera, last: float = -math.inf) -> Iterator[Frame]:
    """Yield the frames that fit this camera and are later than those before: a pose is found again by its time."""
    for frame in frames:
        check_frame(frame, camera)
        if frame.timestamp <= last:
            warnings.warn(
                LeftOutWarning(
                    f"`{frame.name}` has the time {frame.timestamp:.6f} s, which is not after {last:.6f} s of the "
                    "frame before; the frame is skipped"
                ),
                stacklevel=2,
            )
            continue
        last = frame.timestamp
        yield frame


def with_own_depth(frames: Iterable[Frame], before: Collection[Frame] = ()) -> Iterator[Frame]:
    """Yield the frames, without the depth image if it is identical to the previous frame's.

    A recorder with a slower depth camera repeats its images: such a depth was measured at an earlier camera pose.
    before: the frames before the first one.
    """
    last, repeated = None, False
    for number, frame in enumerate(chain(before, frames)):
        repeated = last is not None and _same_depth(frame, last) and (repeated or not _same(frame.image, last.image))
        if number >= len(before):
            yield replace(frame, depth=None) if repeated else frame
        last = frame


def _same_depth(frame: Frame, last: Frame) -> bool:
    if frame.depth is None or last.depth is None:
        return False
    some = np.s_[::16, ::16]  # enough of nearly all frames
    return _same(frame.depth[some], last.depth[some]) and _same(frame.depth, last.depth)


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.shape == other.shape and one.tobytes() == other.tobytes()


def _described(
    frames: Iterator[Frame], camera: Camera, roles: Roles, clock: Clock, waiting: WaitContext
) -> Iterator[tuple[Frame, Description]]:
    """Yield undistorted frames, prepared in a thread while earlier ones are tracked.

    With key points if every frame needs them.
    """
    undistorter, intrinsics = camera.undistorter(), np.array(camera.intrinsics, np.float64)

    def describe(image: np.ndarray, stage: str) -> Features:
        with clock.measure(stage):
            features = roles.points.describe(image)
            check_answer("points.describe", features, Features)
            return features if roles.static_overlay is None else roles.static_overlay.without_points(features)

    def prepare(frame: Frame) -> tuple[Frame, Description]:
        image = undistorter.image(frame.image)
        depth = None if frame.depth is None else undistorter.depth(frame.depth)
        if depth is not None and roles.static_overlay is not None:
            depth = roles.static_overlay.without_depth(depth)
        frame = Frame(frame.index, frame.timestamp, image, depth, frame.name)
        view = None
        if roles.alignment is not None and roles.metric and camera.known:
            with clock.measure("prepare (own thread)"):
                view = RgbdView.of(image, roles.tracking_depth(depth), intrinsics)
        if roles.follows:
            return frame, Description(lambda: describe(image, "describe"), view, intrinsics)
        return frame, Description.of(describe(image, "describe (own thread)"), view, intrinsics)

    def read_and_prepare() -> tuple[Frame, Description] | None:
        with clock.measure("read (own thread)"):
            frame = next(frames, None)
        return None if frame is None else prepare(frame)

    yield from prefetched(read_and_prepare, AHEAD, waiting)
