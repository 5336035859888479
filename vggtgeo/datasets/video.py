"""A video file, decoded frame by frame by PyAV (`video_stream.py`)."""

import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from vggtgeo.datasets.depth_files import MILLIMETRES, metres_of_codes
from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.intrinsics import MAX_ASPECT, camera_from_folder, guess_with_warning
from vggtgeo.datasets.video_stream import (
    ChosenTracks,
    DepthStream,
    Track,
    VideoStream,
    choose_tracks,
    open_container,
    open_stream,
    shown_size,
    stands_alone,
    tracks_of,
)
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning, NoteWarning

FASTEST = 1000
"""Frames a second that a header may state."""
_FALLBACK_RATE = 30.0
_HEAD = 4096
_NO_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
"""Control characters other than those of text and terminals: every video has some."""
Size = tuple[int, int]


@dataclass(frozen=True)
class VideoFile:
    """A video without ground truth; with depth if a track of it says so. Intrinsics come from a file in its folder.

    Fields: path; name; camera; rate, frames/s; count, the container's number of frames (an estimate);
    given_rate, frames/s in place of the container's times; tracks, those that are read, of a file with several.
    """

    path: Path
    name: str
    camera: Camera
    rate: float
    count: int
    has_depth: bool = False
    given_rate: float | None = None
    tracks: ChosenTracks | None = None

    @classmethod
    def open(cls, path: Path, depth: bool = True) -> Self:
        """Read the header and the first frame. depth: False to leave a track of depth alone.

        Raises:
            InputError: no frame can be decoded, or the depth has another size than the images.

        """
        _check_content(path)
        tracks = _tracks(path, depth)
        with open_stream(path, None if tracks is None else tracks.images.index) as stream:
            first = next((frame for _, frame in stream.frames()), None)
            if first is None:
                raise InputError(
                    f"`{path}` has no frame that can be decoded (its codec: {stream.codec}): it is damaged, or of a "
                    "kind that FFmpeg does not decode; `ffmpeg -i FILE -c:v libx264 NEW.mp4` converts others"
                )
            width, height = shown_size(first)
            aspect = _pixel_aspect(stream, first)
            rate, count, has_times = stream.rate, stream.count, stream.has_times
        if tracks is not None and tracks.depth is not None:
            _check_depth(path, tracks, tracks.depth, (width, height))
        camera = camera_from_folder(path.parent, width, height) or guess_with_warning(str(path), width, height, aspect)
        if not has_times:
            text = "is a stream without times: is its header damaged?"
            _warn(InputWarning(f"`{path}` {text} {rate:g} frames a second are assumed: give `--fps` if it has others"))
        has_depth = tracks is not None and tracks.depth is not None
        rate = rate if 0 < rate < FASTEST else _FALLBACK_RATE
        return cls(path, path.name, camera, rate, max(count, 1), has_depth, None, tracks)

    def __len__(self) -> int:
        return self.count

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`; frames that are skipped are not converted.

        Damaged frames, and those of another size than the first, are left out, with a LeftOutWarning. A stream that
        ends before its container says so ends with an InputWarning.
        """
        check_selection(self.name, self.count, start, end, stride)
        return self._decode(_Selection(start, end, stride))

    def ground_truth(self) -> Trajectory | None:
        """Return None."""
        return None

    def _decode(self, selection: "_Selection") -> Iterator[Frame]:
        index, time = 0, -math.inf
        damaged: int | None = None  # the first of the frames that cannot be decoded, while they last
        size, others = (self.camera.width, self.camera.height), []
        with self._streams() as (stream, depths):
            for failed, frame in stream.frames():
                stated = stream.time(frame)
                if failed or frame.is_corrupt:
                    damaged = index if damaged is None else damaged
                    index += self._missed(failed, stated - time, index)
                if selection.is_behind(index):
                    break
                time = self._time(index, time, stated)
                if damaged is not None and stands_alone(frame) and not frame.is_corrupt:
                    self._warn_of_damage(selection, damaged, index)
                    damaged = None
                if damaged is None and selection.has(index):
                    if shown_size(frame) != size:
                        others.append(f"frame {index} is {shown_size(frame)[0]} x {shown_size(frame)[1]}")
                    else:
                        depth = None if depths is None else self._depth(depths, stated)
                        yield Frame(index, time, stream.rgb(frame), depth, f"{self.name}, frame {index}")
                index += 1
        if damaged is not None:
            self._warn_of_damage(selection, damaged, index)
        if others:
            text = f"{len(others)} frames are not {size[0]} x {size[1]} pixels as the first ({others[0]})"
            _warn(LeftOutWarning(f"`{self.name}`: {text}; they are skipped", len(others)))
        wanted = self.count if selection.end is None else min(selection.end, self.count)
        if index < wanted:
            counts = f"ends after {index} frames; its header says {self.count}"
            text = f"`{self.name}` {counts}: is the file cut off, or damaged, or was it trimmed?"
            _warn(InputWarning(text))  # not as left out: the count of an MKV is an estimate where the rate varies

    @contextmanager
    def _streams(self) -> Iterator[tuple[VideoStream, DepthStream | None]]:
        """Return the images, and the depth where it is read."""
        with open_stream(self.path, None if self.tracks is None else self.tracks.images.index) as images:
            if self.tracks is None or self.tracks.depth is None or not self.has_depth:
                yield images, None
                return
            with open_stream(self.path, self.tracks.depth.index) as depth:
                yield images, DepthStream(depth, images.start)

    def _depth(self, depths: DepthStream, time: float) -> np.ndarray:
        """Return depth at a time of the stream, metres, NaN for none."""
        codes = depths.at(time)
        shape = self.camera.height, self.camera.width
        return np.full(shape, np.nan, np.float32) if codes is None else metres_of_codes(codes, MILLIMETRES)

    def _missed(self, failed: int, seconds: float, index: int) -> int:
        """Return frames that are missing before one: those that failed, or those that the time since the last one
        holds.
        """
        passed = round(seconds * self.rate) - 1 if math.isfinite(seconds) else 0
        return max(failed, min(passed, self.count - index - 1))

    def _time(self, index: int, previous: float, stated: float) -> float:
        """Return the container's time where it increases (the rate of phones varies), else by the rate."""
        if index == 0:
            return 0.0
        if self.given_rate is not None:
            return index / self.given_rate
        return stated if stated > previous else previous + 1.0 / self.rate

    def _warn_of_damage(self, selection: "_Selection", first: int, behind: int) -> None:
        if count := selection.count(first, behind):
            text = f"frames {first} to {behind - 1} cannot be decoded, or are predicted from such"
            _warn(LeftOutWarning(f"`{self.name}` is damaged: {text}; they are skipped", count))


@dataclass(frozen=True)
class _Selection:
    """The frames start, start + stride, ... below end."""

    start: int
    end: int | None
    stride: int

    def is_behind(self, index: int) -> bool:
        return self.end is not None and index >= self.end

    def has(self, index: int) -> bool:
        return index >= self.start and not self.is_behind(index) and (index - self.start) % self.stride == 0

    def count(self, first: int, behind: int) -> int:
        """Return how many lie from `first` to before `behind`."""
        return sum(self.has(index) for index in range(first, behind))


def _pixel_aspect(stream: VideoStream, frame: Any) -> float:
    """Return width of a shown pixel over its height (1440 x 1080 are shown as 16:9); 1 if not stated, or impossible."""
    aspect = stream.pixel_aspect
    if not 1 / MAX_ASPECT <= aspect <= MAX_ASPECT:
        return 1.0
    return 1 / aspect if shown_size(frame) != (frame.width, frame.height) else aspect


def _tracks(path: Path, depth: bool) -> ChosenTracks | None:
    """Return the tracks that are read, with a note; None if the first is all that there is to be read."""
    with open_container(path) as container:
        tracks = tracks_of(container)
    if len(tracks) < 2:
        return None
    chosen = choose_tracks(tracks)
    chosen = chosen if depth else replace(chosen, depth=None)
    beside = f", depth in millimetres of {chosen.depth}" if chosen.depth else ""
    left = ", ".join(map(str, chosen.others))
    _warn(NoteWarning(f"`{path}`: images of {chosen.images}{beside}" + (f"; not read: {left}" if left else "")))
    if depth and (maybe := chosen.maybe_depth):
        _warn(
            InputWarning(
                f"`{path}`: {', '.join(map(str, maybe))} may be depth (16 bits of grey), and has no title that says so:"
                f" not used; `ffmpeg -i FILE -map 0 -c copy -metadata:s:v:{maybe[0].number} title=DEPTH NEW.mkv` gives "
                "the title, for depth in millimetres"
            )
        )
    return chosen


def _check_depth(path: Path, chosen: ChosenTracks, depth: Track, size: Size) -> None:
    if (depth.width, depth.height) != size:
        raise InputError(
            f"`{path}`: the depth of {depth} has another size than the images of {chosen.images}: register it first "
            "(Azure Kinect: `k4a_transformation_depth_image_to_color_camera`), or leave it out with --rgb-only"
        )


def _check_content(path: Path) -> None:
    """Raise InputError for an empty file or text: FFmpeg draws letters, and opens lists of addresses (`m3u8`)."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:  # a disk that fails
        raise InputError(f"`{path}` cannot be read: {error.strerror}; give a copy on a disk that works") from None
    if not _NO_TEXT.search(head):
        raise InputError(f"`{path}` is a text file; give a folder of images or a video file")


def _warn(warning: InputWarning) -> None:
    warnings.warn(warning, stacklevel=3)
