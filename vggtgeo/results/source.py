"""Where a run's frames come from: a folder, a file, a reader, a stream of images; opened, checked and reduced."""

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
from vggtgeo.datasets.frame import check_selection
from vggtgeo.datasets.in_memory import FrameStream, frame_stream
from vggtgeo.datasets.reduced import reduced
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, NoteWarning
from vggtgeo.results.checkpoints import Checkpoints
from vggtgeo.results.summary import lens_of
from vggtgeo.simulation.sequence import SyntheticSequence
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.state import Slam

LEAST_SIDE = 32
"""Pixels: windows of features and of the image pyramid do not fit into less."""


@dataclass(frozen=True, eq=False)
class Source:
    """What an estimator may see, and the truth, set apart for the comparison.

    simulated: whether frames are rendered. truth_in_metres: whether lengths of the truth are metres; those of COLMAP
    have a unit of their own.
    """

    name: str
    frames: Sequence | FrameStream
    truth: Trajectory | None
    read: Camera
    """Of the images before they were reduced."""
    simulated: bool = False
    truth_in_metres: bool = True

    @property
    def camera(self) -> Camera:
        return self.frames.camera

    @property
    def has_depth(self) -> bool:
        return self.frames.has_depth

    def check(self, start: int, end: int | None, stride: int) -> None:
        """InputError for a selection that is none, or images too small for features, before anything is compiled."""
        if min(self.camera.width, self.camera.height) < LEAST_SIDE:
            size, read = (f"{camera.width} x {camera.height}" for camera in (self.camera, self.read))
            smaller = "" if size == read else f", {size} after they were reduced"
            raise InputError(
                f"the images of `{self.name}` are {read} pixels{smaller}; both sides must be at least {LEAST_SIDE}"
            )
        length = sys.maxsize if isinstance(self.frames, FrameStream) else len(self.frames) or sys.maxsize
        check_selection(self.name, length, start, end, stride)

    def known(self, selection: tuple[int, int | None, int]) -> dict[str, Any]:
        """What tells this source from another before a frame is read."""
        length = None if isinstance(self.frames, FrameStream) else len(self.frames)
        size = f"{self.camera.width} x {self.camera.height}"
        return {
            **{"name": self.name, "frames": length, "size": size, "camera": self.camera},
            **{"depth": self.has_depth, "start, end, stride": selection},
        }

    def resumable(self, asked: Checkpoints | None) -> Checkpoints | None:
        """InputError for a resumed run over frames that do not come again."""
        if asked is not None and asked.resume and self.count(0, None, 1) is None:
            raise InputError(f"the frames of `{self.name}` come once: such a run cannot be resumed")
        return asked

    def comes_again(self, selection: tuple[int, int | None, int]) -> bool:
        """Whether frames can be looked at before the run; simulated ones cost more to render than that is worth."""
        return bool(self.count(*selection)) and not self.simulated

    def some_pictures(
        self, start: int, end: int | None, stride: int, most: int, apart: int
    ) -> list[UInt8[np.ndarray, "h w 3"]]:
        """At most `most` of the first images of a selection that comes again, at most `apart` of its frames apart."""
        count = self.count(start, end, stride)
        if not count or isinstance(self.frames, FrameStream):
            return []
        step = max(min(apart, count // most), 1)
        until = start + min(count, most * step) * stride
        # What is wrong with a frame, or with all of them, is told when the run comes to it.
        with warnings.catch_warnings(), suppress(InputError):
            warnings.simplefilter("ignore", InputWarning)
            frames = SequenceView(self.frames, self.camera, False).frames(start, until, step * stride)
            return [frame.image for frame in frames]
        return []

    def count(self, start: int, end: int | None, stride: int) -> int | None:
        """Frames of a selection; None where only their end will tell."""
        if isinstance(self.frames, FrameStream):
            return None
        length = len(self.frames)
        if not length:  # a camera that is running
            return None
        return len(range(start, length if end is None else min(length, end), stride))


def opened(
    frames: str | os.PathLike[str] | Sequence | Iterable[Any], camera: Camera | None, settings: SlamSettings
) -> Source:
    """Opens what a run was given, as `reconstruct` takes it; images are reduced to `camera.most_pixels`."""
    most = settings.camera.most_pixels
    if isinstance(frames, str | os.PathLike):
        frames = open_sequence(Path(frames))
    if not isinstance(frames, Sequence):
        stream = frame_stream(frames, camera)
        return Source("frames", reduced(stream, most), None, stream.camera)
    name = frames.name.encode("utf-8", "replace").decode()  # a folder's name may be no UTF-8
    view = SequenceView(frames, camera or frames.camera, frames.has_depth, has_truth=False)
    simulated = isinstance(frames, SyntheticSequence)
    truth, metres = _truth(frames), getattr(frames, "truth_in_metres", True)
    return Source(name, reduced(view, most), truth, view.camera, simulated, metres)


def _truth(sequence: Sequence) -> Trajectory | None:
    """The truth for the comparison; one that cannot be read costs that only."""
    try:
        truth = sequence.ground_truth()
        if truth is not None and not getattr(sequence, "truth_in_metres", True):
            text = "are in a unit of their own, and errors against them in the same, after Sim(3) alignment"
            warnings.warn(f"the true poses of `{sequence.name}` {text}", NoteWarning, stacklevel=4)
        return truth
    except InputError as error:
        warnings.warn(f"the truth cannot be used and is left out: {error}", InputWarning, stacklevel=4)
        return None


def as_read(source: Source, slam: Slam) -> dict[str, Any]:
    """What the summary says of images that were reduced: both sizes, and the camera of the images as they were read."""
    size, read = (f"{camera.width} x {camera.height}" for camera in (source.camera, source.read))
    if size == read:
        return {}
    fx, fy, cx, cy = map(float, slam.intrinsics)
    enlarged = lambda camera: camera.resized(source.read.width, source.read.height)
    found = enlarged(replace(source.camera, intrinsics=(fx, fy, cx, cy)))
    camera = dict(zip(("fx", "fy", "cx", "cy"), found.intrinsics, strict=True))
    lens = {} if slam.camera.lens is None else {"lens": lens_of(enlarged(slam.camera.lens))}
    return {"images_reduced": {"from": read, "to": size, "intrinsics_as_read": camera}, **lens}
