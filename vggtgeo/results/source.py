"""Open and validate the input of a run, reduce its images, read its pose prior, and find static overlays."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from vggtgeo.datasets import Sequence, SequenceView, open_sequence
from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.pose_files import load_trajectory
from vggtgeo.datasets.views import FrameStream, frame_stream, reduced
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_kind
from vggtgeo.io.errors import InputError, InputWarning, NoteWarning, warn
from vggtgeo.results.checkpoints import Checkpoints
from vggtgeo.results.summary import lens_parameters
from vggtgeo.simulation.sequence import SyntheticSequence
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.perception.static_overlay import (
    MAX_IMAGES,
    STRIDE,
    StaticOverlay,
    find_static_overlay,
    small_grey,
    static_overlay_of,
)
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.findings import Finding
from vggtgeo.slam.verdict.judge import check_static_overlay

MIN_SIDE = 32
"""Minimum pixels of a side of an image: the windows of features and of the image pyramid need them."""
RECORDED = "recorded"
"""Value of `pose_prior` for the poses of the recording."""
PosePrior = str | os.PathLike[str] | Trajectory | None


@dataclass(frozen=True, eq=False)
class Source:
    """Frames for the estimator, and separately the ground truth for the evaluation.

    read: camera of the images before they were reduced. simulated: whether frames are rendered. truth_in_metres:
    whether the ground truth is metric; poses of COLMAP have an unknown scale.
    """

    name: str
    frames: Sequence | FrameStream
    truth: Trajectory | None
    read: Camera
    simulated: bool = False
    truth_in_metres: bool = True

    @property
    def camera(self) -> Camera:
        return self.frames.camera

    @property
    def has_depth(self) -> bool:
        return self.frames.has_depth

    @property
    def length(self) -> int | None:
        """Number of frames; None for a stream or a live camera."""
        return None if isinstance(self.frames, FrameStream) else len(self.frames) or None

    def check(self, start: int, end: int | None, stride: int) -> None:
        """Raise InputError for an invalid selection, or for images that are too small for features."""
        if min(self.camera.width, self.camera.height) < MIN_SIDE:
            size, read = (f"{camera.width} x {camera.height}" for camera in (self.camera, self.read))
            smaller = "" if size == read else f", reduced to {size}"
            raise InputError(f"the images of `{self.name}` must have sides of {MIN_SIDE} pixels, got {read}{smaller}")
        check_selection(self.name, self.length or sys.maxsize, start, end, stride)

    def identity(self, selection: tuple[int, int | None, int]) -> dict[str, Any]:
        """Return the properties that identify this source without reading a frame."""
        size = f"{self.camera.width} x {self.camera.height}"
        return {
            **{"name": self.name, "frames": self.length, "size": size, "camera": self.camera},
            **{"depth": self.has_depth, "start, end, stride": selection},
        }

    def resumable(self, asked: Checkpoints | None) -> Checkpoints | None:
        """Return `asked`; raise InputError if it would resume a stream, whose frames cannot be read again."""
        if asked is not None and asked.resume and self.length is None:
            raise InputError(f"`resume` must be False for a stream, whose frames cannot be read again: `{self.name}`")
        return asked

    def repeatable(self, selection: tuple[int, int | None, int]) -> bool:
        """Return whether frames can be read before the run; rendering simulated frames twice would be too slow."""
        return bool(self.count(*selection)) and not self.simulated

    def sample_images(
        self, start: int, end: int | None, stride: int, max_images: int, max_step: int
    ) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Return up to `max_images` of the first images of a selection, at most `max_step` frames apart.

        The list is empty for a stream.
        """
        count = self.count(start, end, stride)
        if not count or isinstance(self.frames, FrameStream):
            return []
        step = max(min(max_step, count // max_images), 1)
        until = start + min(count, max_images * step) * stride
        # Invalid frames are reported by the run.
        with warnings.catch_warnings(), suppress(InputError):
            warnings.simplefilter("ignore", InputWarning)
            frames = SequenceView(self.frames, self.camera, False).frames(start, until, step * stride)
            return [frame.image for frame in frames]
        return []

    def count(self, start: int, end: int | None, stride: int) -> int | None:
        """Return the number of frames of a selection; None for a stream."""
        if self.length is None:
            return None
        return len(range(start, self.length if end is None else min(self.length, end), stride))


def open_source(
    frames: str | os.PathLike[str] | Sequence | Iterable[Any], camera: Camera | None, settings: SlamSettings
) -> Source:
    """Open the `frames` of `reconstruct`; reduce images to at most `camera.max_pixels`."""
    max_pixels = settings.camera.max_pixels
    if isinstance(frames, str | os.PathLike):
        frames = open_sequence(Path(frames))
    if not isinstance(frames, Sequence):
        stream = frame_stream(frames, camera)
        return Source("frames", reduced(stream, max_pixels), None, stream.camera)
    name = frames.name.encode("utf-8", "replace").decode()  # a folder's name need not be UTF-8
    view = SequenceView(frames, camera or frames.camera, frames.has_depth, has_truth=False)
    simulated = isinstance(frames, SyntheticSequence)
    truth, metres = _truth(frames), getattr(frames, "truth_in_metres", True)
    return Source(name, reduced(view, max_pixels), truth, view.camera, simulated, metres)


def _truth(sequence: Sequence) -> Trajectory | None:
    """Return the ground truth; None, with a warning, if it cannot be read, since the run does not need it."""
    try:
        truth = sequence.ground_truth()
        if truth is not None and not getattr(sequence, "truth_in_metres", True):
            text = "has an unknown scale: errors are in its own unit, after Sim(3) alignment"
            warn(f"the ground truth of `{sequence.name}` {text}", NoteWarning)
        return truth
    except InputError as error:
        warn(f"the ground truth is invalid and not used: {error}")
        return None


def reduction_summary(source: Source, slam: Slam) -> dict[str, Any]:
    """Return the summary's entries on reduced images: both sizes, and the camera of the original images."""
    size, read = (f"{camera.width} x {camera.height}" for camera in (source.camera, source.read))
    if size == read:
        return {}
    fx, fy, cx, cy = map(float, slam.intrinsics)
    enlarge = lambda camera: camera.resized(source.read.width, source.read.height)
    original = enlarge(replace(source.camera, intrinsics=(fx, fy, cx, cy)))
    camera = dict(zip(("fx", "fy", "cx", "cy"), original.intrinsics, strict=True))
    lens = {} if slam.camera.lens is None else {"lens": lens_parameters(enlarge(slam.camera.lens))}
    return {"images_reduced": {"from": read, "to": size, "intrinsics_as_read": camera}, **lens}


def with_pose_prior(source: Source, given: PosePrior) -> tuple[Source, RecordedPoses | None]:
    """Return the source and the pose prior; poses of the recording are either the prior or the ground truth.

    Raises InputError if the source has no recorded poses, or the file cannot be read.
    """
    check_kind(
        "pose_prior",
        given,
        str | os.PathLike | Trajectory | None,
        "'recorded', a file of poses, a `vggtgeo.Trajectory`, or None",
    )
    if given is None:
        return source, None
    if isinstance(given, Trajectory):
        return source, RecordedPoses(given)
    if given != RECORDED:
        return source, RecordedPoses(load_trajectory(Path(given)))
    if source.truth is None:
        raise InputError(
            f"`pose_prior` must not be 'recorded' for `{source.name}`, which has no recorded poses; give a file of "
            "poses (`timestamp tx ty tz qx qy qz qw`), or None"
        )
    return replace(source, truth=None), RecordedPoses(source.truth, metres=source.truth_in_metres)


class StaticOverlaySearch(Callback):
    """Finds a static overlay in the images of a run, for perception and for the verdict.

    found: the overlay that perception masks; None before `search`, and if no overlay is certain.
    """

    def __init__(self) -> None:
        self.found: StaticOverlay | None = None
        self._overlay: StaticOverlay | None = None
        self._searched = False
        self._images: list[np.ndarray] = []
        self._size = (0, 0)
        self._stride = 1
        self._frames = 0

    def search(self, source: Source, selection: tuple[int, int | None, int]) -> None:
        """Search in a sample of the first frames, before the run; warn of an overlay that is masked."""
        self._searched = True
        self._overlay = find_static_overlay(source.sample_images(*selection, MAX_IMAGES, STRIDE))
        if self._overlay is None or not self._overlay.separable:
            return
        self.found = self._overlay
        warn(
            f"{100 * self.found.share:.1f} % of the image is a static overlay (bars, a watermark, something on the "
            "lens?); features and depth there are ignored"
        )

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Keep 20 to 40 images, evenly spaced over at most the first `MAX_IMAGES * STRIDE` frames."""
        if self._searched or self._frames >= MAX_IMAGES * STRIDE:
            return
        if self._frames % self._stride == 0:
            self._size = frame.image.shape[1], frame.image.shape[0]
            self._images.append(small_grey(frame.image))
            if len(self._images) == 2 * MAX_IMAGES:
                self._images, self._stride = self._images[::2], 2 * self._stride
        self._frames += 1

    def findings(self) -> tuple[Finding, ...]:
        """Return the findings for the verdict, after the last frame."""
        if not self._searched:
            self._overlay = static_overlay_of(self._images, self._size)
        return check_static_overlay(self._overlay, left_out=self.found is not None)
