"""Streams of a video file, decoded by PyAV: which are the images, which their depth.

Action cameras write a small preview beside the recording; k4arecorder writes COLOR, DEPTH and IR into one Matroska
file.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from vggtgeo.io.errors import InputError

DELAY = 0.02
"""Seconds between an image and its depth at most."""
_NO_TIMESTAMPS = 0x80
"""Flag of FFmpeg's formats that are streams without a container (AVFMT_NOTIMESTAMPS)."""
_IMAGES = ("_pipe", "gif", "image2", "ico")
"""Formats of FFmpeg that hold images: it takes one for a video of one frame."""
_PREDICTED = (2, 3)
"""Types of frames that are made of others: P and B."""


class VideoStream:
    """One stream of an open file; `open_stream` opens it."""

    def __init__(self, container: Any, index: int | None) -> None:
        """container: of `av`. index: of the stream among all of the file, None for the first of video."""
        self._container = container
        self._stream = container.streams.video[0] if index is None else container.streams[index]
        self._stream.thread_type = "AUTO"
        self._conversion = av.video.reformatter.VideoReformatter()
        self.start = float((self._stream.start_time or 0) * (self._stream.time_base or 0))
        """Time of the first frame, seconds of the file."""

    @property
    def codec(self) -> str:
        """FFmpeg's name of the codec."""
        return str(self._stream.codec_context.name)

    @property
    def rate(self) -> float:
        """Return frames a second as stated; 0 for none."""
        return float(self._stream.guessed_rate or self._stream.average_rate or 0)

    @property
    def count(self) -> int:
        """Return frames as stated, or by the stated duration; 0 for none."""
        return int(self._stream.frames or round(self._seconds() * self.rate))

    @property
    def pixel_aspect(self) -> float:
        """Return width of a stored pixel over its height as stated; 0 for none."""
        return float(self._stream.sample_aspect_ratio or 0)

    @property
    def has_times(self) -> bool:
        """Return whether the file has a container, which states the time of each frame."""
        return not int(self._container.format.flags) & _NO_TIMESTAMPS

    def frames(self) -> Iterator[tuple[int, Any]]:
        """Yield each decoded frame, and how many packets before it could not be decoded."""
        failed = 0
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:  # of the container: there is nothing to be read behind it
                return
            if packet is None:
                return
            try:
                decoded = packet.decode()
            except av.error.FFmpegError:
                failed += 1
                continue
            for frame in decoded:
                yield failed, frame
                failed = 0

    def time(self, frame: Any) -> float:
        """Return seconds of a frame since the stream's start; NaN if it has no time."""
        return float(frame.time) - self.start if frame.time is not None and self.has_times else math.nan

    def rgb(self, frame: Any) -> UInt8[np.ndarray, "h w 3"]:
        """Return the pixels of a frame, rotated as its file states."""
        turns = round(frame.rotation / 90)
        # Of 10 bits FFmpeg's RGB differs from its BGR by up to 5: BGR is that of OpenCV. A frame's own `to_ndarray`
        # sets the conversion up anew each time, which takes as long as the conversion.
        image: Any = self._conversion.reformat(frame, format="bgr24", interpolation="BICUBIC").to_ndarray()
        image = np.ascontiguousarray(np.rot90(image, turns))
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)

    def _seconds(self) -> float:
        """Return the duration of the stream as Matroska states it, else of the whole file."""
        stated = re.fullmatch(r"(\d+):(\d+):([\d.]+)", self._stream.metadata.get("DURATION", ""))
        if stated is None:
            return (self._container.duration or 0) * 1e-6
        return 3600.0 * int(stated[1]) + 60.0 * int(stated[2]) + float(stated[3]) - self.start


def stands_alone(frame: Any) -> bool:
    """Return whether a frame is decoded from its own data; others, after damaged ones, are made of what is missing."""
    return int(frame.pict_type) not in _PREDICTED


def shown_size(frame: Any) -> tuple[int, int]:
    """Return width and height of a frame after it is rotated as its file states."""
    return (frame.height, frame.width) if round(frame.rotation / 90) % 2 else (frame.width, frame.height)


class DepthStream:
    """Depth of a stream of 16-bit grey, asked for by rising times."""

    def __init__(self, stream: VideoStream, start: float) -> None:
        """start: the time of the images' first frame, seconds of the file."""
        self._later = stream.start - start
        self._frames = ((stream.time(frame) + self._later, frame) for _, frame in stream.frames())
        self._near = [next(self._frames, None)]

    def at(self, time: float) -> UInt16[np.ndarray, "h w"] | None:
        """Return the values nearest to a time, seconds since the images' first; None if none is within `DELAY`."""
        while self._near[-1] is not None and self._near[-1][0] < time:
            self._near = [self._near[-1], next(self._frames, None)]
        near = [one for one in self._near if one is not None and abs(one[0] - time) <= DELAY]
        if not near:
            return None
        _, frame = min(near, key=lambda one: abs(one[0] - time))
        return np.asarray(frame.to_ndarray(format="gray16le"))


@contextmanager
def open_container(path: Path) -> Iterator[Any]:
    """Open a video file; raise InputError if FFmpeg cannot, or if it has no stream of video."""
    try:
        container = av.open(os.path.abspath(path))  # what is before a `:` would be a protocol otherwise
    except (av.error.FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"`{path}` cannot be opened as a video ({reason}): it is damaged, or not a video; give an MP4, MOV, MKV, "
            "AVI or WebM"
        ) from None
    with container:
        if container.format.name.endswith(_IMAGES):
            raise InputError(
                f"`{path}` is an image ({container.format.name}); give the folder of the sequence, or a video file"
            )
        if not any(stream.codec_context is not None for stream in container.streams.video):
            raise InputError(f"`{path}` has no stream of video that can be decoded")
        yield container


@contextmanager
def open_stream(path: Path, index: int | None = None) -> Iterator[VideoStream]:
    """Open one stream of a video file; see `VideoStream` and `open_container`."""
    with open_container(path) as container:
        yield VideoStream(container, index)


_DEPTH = re.compile(r"(^|[^a-z])depth([^a-z]|$)", re.IGNORECASE)
_INFRARED = re.compile(r"(^|[^a-z])(ir|infrared)([^a-z]|$)", re.IGNORECASE)
_ATTACHED_PICTURE = 0x400
_UNNAMED = "VideoHandler"
"""Title that FFmpeg gives a track without one."""


@dataclass(frozen=True)
class Track:
    """A stream of video.

    Fields: index, among all streams of the file. number, among those of video. title, "" for none. codec and pixels,
    FFmpeg's names. width, height, pixels. cover, whether it is a single picture for lists of files.
    """

    index: int
    number: int
    title: str
    codec: str
    pixels: str
    width: int
    height: int
    cover: bool = False

    def __str__(self) -> str:
        title = f", `{self.title}`" if self.title else ""
        return f"track {self.number} ({self.codec}, {self.width} x {self.height}{title})"

    @property
    def has_16_bits_of_grey(self) -> bool:
        """Return whether its pixels may be depth in millimetres."""
        return self.pixels.startswith("gray16")

    @property
    def is_depth(self) -> bool:
        """Return whether its title says so."""
        return bool(_DEPTH.search(self.title))


@dataclass(frozen=True)
class ChosenTracks:
    """Fields: images and depth, the tracks that are read. others, those that are not."""

    images: Track
    depth: Track | None
    others: tuple[Track, ...]

    @property
    def maybe_depth(self) -> tuple[Track, ...]:
        """Tracks that are not read and may be depth, without a title that says so."""
        untitled = (one for one in self.others if one.has_16_bits_of_grey and not _INFRARED.search(one.title))
        return tuple(untitled) if self.depth is None else ()


def choose_tracks(tracks: Sequence[Track]) -> ChosenTracks:
    """Choose the largest track in colour, before grey and infrared, and the 16-bit grey one whose title says depth.

    tracks: at least one.
    """
    videos = [track for track in tracks if not track.cover] or list(tracks)
    depth = next((track for track in videos if track.is_depth and track.has_16_bits_of_grey), None)
    rank = lambda track: (
        track.is_depth,
        bool(_INFRARED.search(track.title)),
        track.pixels.startswith("gray"),
        -track.width * track.height,
    )
    images = min(videos, key=rank)
    depth = None if depth is images else depth
    return ChosenTracks(images, depth, tuple(track for track in tracks if track not in (images, depth)))


def tracks_of(container: Any) -> tuple[Track, ...]:
    """Return the tracks of video of an open `av` container, without those of an unknown codec."""
    streams = enumerate(container.streams.video)
    return tuple(_track(number, stream) for number, stream in streams if stream.codec_context is not None)


def _track(number: int, stream: Any) -> Track:
    codec = stream.codec_context
    title = stream.metadata.get("title") or stream.metadata.get("handler_name") or ""
    title = "" if title == _UNNAMED else str(title)
    cover = bool(int(stream.disposition) & _ATTACHED_PICTURE)
    return Track(stream.index, number, title, codec.name, str(codec.pix_fmt), codec.width, codec.height, cover)
