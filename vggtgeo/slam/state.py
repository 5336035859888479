"""The one value that the pipeline folds over frames."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np

from vggtgeo.bundle.problem import State
from vggtgeo.geometry.camera import Camera
from vggtgeo.models.roles import Features
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import Factor, MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.tracking.evidence import Evidence
from vggtgeo.slam.tracking.rgbd_view import RgbdView
from vggtgeo.slam.window.adjustment import Adjustment
from vggtgeo.slam.window.window_prior import WindowPrior
from vggtgeo.solvers.levenberg_marquardt import IterationRecord

LEAST_TO_FIND_A_CAMERA = 3
"""Keyframes; as many as the last adjustment needs."""
GUESSED = 0.1
"""A prior on the focal length that is wider than this share of it stands for a guess."""


def was_given(given: np.ndarray, sigma: np.ndarray, found: bool) -> bool:
    """Whether a prior of the intrinsics, mean and standard deviation in pixels, is that of a camera that was given.

    found: by a first pass, maybe so far from the guess that this one's `sigma` is a small share of it.
    """
    return bool(not found and sigma[0] < GUESSED * given[0])


@dataclass(frozen=True, eq=False)
class SecondMotion:
    """From a second keyframe to a frame, see `frame_refinement.py`. relative: float64 [4, 4], camera -> camera.
    information: float64 [6, 6] over its left tangent, translation first, of the error that no sample removes, too.
    """

    keyframe: int
    relative: np.ndarray
    information: np.ndarray


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Key points of a keyframe that a frame shows, see `frame_poses.py`. slots: int32 [m], in `Keyframe.points`.
    pixels: float32 [m, 2], where the frame shows them.
    """

    slots: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class FramePose:
    """Pose of one frame relative to a keyframe, so that it follows when the keyframe is adjusted.

    relative: float64 [4, 4], reference camera -> this camera. tracked: False where no pose could be believed;
    `relative` is then that of the last one. evidence: what speaks for the pose, and how well it is known.
    """

    frame: int
    timestamp: float
    reference: int
    relative: np.ndarray
    tracked: bool
    inliers: int
    evidence: Evidence = field(default_factory=Evidence)
    arrival: tuple[int, np.ndarray] | None = None
    """Of a frame that became a keyframe: the earlier keyframe it was tracked against, and its pose relative to that
    one as tracked, before any adjustment."""
    second: SecondMotion | None = None
    seen: SeenPoints | None = None
    """Points of its keyframe, where its pose came from points alone."""


@dataclass(frozen=True, eq=False)
class Waiting:
    """A frame without a pose so far: seen before there was a map, or while tracking was lost. It is placed as soon as
    there is a map that it fits into.
    """

    frame: int
    timestamp: float
    image: np.ndarray
    features: Features
    depth: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class PendingWindow:
    """An adjustment of the window that goes on beside tracking, see `pending_window.py`.

    due: number of frames from which on the state has its result. begun: the state that it began with. result: that
    state, adjusted.
    """

    due: int
    begun: Slam
    result: Future[Slam]

    def __reduce__(self) -> tuple[Callable[..., PendingWindow], tuple[int, Slam, Slam]]:
        """So that states pickle, and copy: with the result, which is waited for."""
        return _done, (self.due, self.begun, self.result.result())


def _done(due: int, begun: Slam, result: Slam) -> PendingWindow:
    future: Future[Slam] = Future()
    future.set_result(result)
    return PendingWindow(due, begun, future)


@dataclass(frozen=True)
class Readout:
    """How long the camera reads an image out, s: from the first row to the last, or column where columns; negative: the
    last is read first. shift: by how much that moves matches in this run, pixels, exceeded by one in ten.
    """

    seconds: float
    columns: bool
    shift: float


@dataclass(frozen=True, eq=False)
class Slam:
    """Everything known after some frames.

    intrinsics: current fx, fy, cx, cy. given_intrinsics, intrinsics_sigma: mean and standard deviation of their prior,
    pixels. keyframes: all, by number. pairs: all matches between them. window: numbers of
    the keyframes that are adjusted, oldest first. prior: what the keyframes that left the window said about it.
    factors: what is known about poses beyond matches: the tracked motion of each keyframe, which holds the map
    together, measured rotations, the unit of a map without metric depth.
    solved: the last window problem and its solution. energies: `1/2 sum rho` of that window before its first and after
    each iteration; iterations: what else each did, where the settings ask for it. frames: every frame's pose.
    velocity: last motion from frame to frame, camera -> camera. waiting: frames without a pose so far.
    reference: number of the keyframe that frames are tracked against, and its view for the alignment. held: keyframes
    that a window keeps where they are, besides origins. lost: frames since tracking
    was lost. origins: the first keyframe of each piece of the map; pieces are tied to nothing else.
    metric: whether lengths are metres. axes: the perpendicular directions of the world's lines, float64 [3, 3] (axes ->
    world), as the first keyframes saw them. notes: what the user should know.
    pose_sigma: of each keyframe after the last adjustment, see `pose_uncertainty.keyframe_sigma`. pending: the
    adjustment of the newest keyframe's window, while it goes on. lens: the distorting camera of the images as they were
    read, where the last adjustment found one: pixels and images of all keyframes, and `intrinsics`, are of images that
    it no longer distorts (`lens.py`). camera_found: nobody gave the camera, and `given_intrinsics` and `lens`
    are what a first pass over the frames found (`first_pass.py`), or the run that made the map which this one goes on
    in: windows hold them, and the last adjustment estimates the camera once more. readout: of the rolling shutter that
    the last adjustment found and took out of the poses (`rolling_shutter.py`); pixels and images stay as they were
    read. between: rows of the last frames, and their views, that wait for the next keyframe (`frame_refinement.py`).
    """

    intrinsics: np.ndarray
    given_intrinsics: np.ndarray
    intrinsics_sigma: np.ndarray
    metric: bool
    keyframes: tuple[Keyframe, ...] = ()
    pairs: tuple[Pair, ...] = ()
    window: tuple[int, ...] = ()
    prior: WindowPrior | None = None
    factors: tuple[Factor, ...] = ()
    solved: tuple[Adjustment, State] | None = None
    energies: np.ndarray | None = None
    iterations: IterationRecord | None = None
    frames: tuple[FramePose, ...] = ()
    velocity: np.ndarray = field(default_factory=lambda: np.eye(4))
    waiting: tuple[Waiting, ...] = ()
    lost: int = 0
    origins: tuple[int, ...] = ()
    axes: tuple[np.ndarray, ...] = ()
    reference: tuple[int, RgbdView | None] | None = None
    held: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    pose_sigma: np.ndarray | None = None
    pending: PendingWindow | None = None
    lens: Camera | None = None
    camera_found: bool = False
    readout: Readout | None = None
    between: tuple[tuple[int, RgbdView], ...] = ()

    def __repr__(self) -> str:
        frames, keyframes = len(self.frames), len(self.keyframes)
        doing = "lost" if self.lost else "waiting for parallax" if self.waiting else "tracking"
        return f"Slam({frames} frame{'s' * (frames != 1)}, {keyframes} keyframe{'s' * (keyframes != 1)}, {doing})"

    @property
    def adjusted_keyframes(self) -> tuple[Keyframe, ...]:
        """All but the newest, where that one's window is still being adjusted."""
        return self.keyframes if self.pending is None else self.keyframes[:-1]

    @property
    def calibrated(self) -> bool:
        """Whether the camera was given, not guessed."""
        return was_given(self.given_intrinsics, self.intrinsics_sigma, self.camera_found)

    @property
    def ties(self) -> tuple[MeasuredRelativePose, ...]:
        """The tracked motions between keyframes."""
        return tuple(factor for factor in self.factors if isinstance(factor, MeasuredRelativePose))

    def pose(self, record: FramePose) -> np.ndarray:
        """World -> camera of a frame, float64 [4, 4], by the current estimate of its keyframe."""
        return record.relative @ self.keyframes[record.reference].pose

    @property
    def last_pose(self) -> np.ndarray:
        """World -> camera of the last frame."""
        return self.pose(self.frames[-1]) if self.frames else np.eye(4)
