"""Video files, decoded frame by frame by PyAV.

A file may have several tracks: action cameras add a small preview, and k4arecorder writes COLOR, DEPTH and IR into one
Matroska file. `choose_tracks` selects the images and their depth.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import av
import cv2
import numpy as np
from jaxtyping import UInt8

from vggtgeo.datasets.frame import Frame, NearestInTime, check_selection
from vggtgeo.datasets.image_files import MILLIMETRES, metres_of_codes
from vggtgeo.datasets.intrinsics import MAX_ASPECT, camera_from_folder, guess_with_warning
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, LeftOutWarning, NoteWarning, warn

MAX_RATE = 1000
"""Maximum frame rate of a header; a higher one is invalid."""
_FALLBACK_RATE = 30.0
_HEAD = 4096
_NOT_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
"""Control characters that text and terminal output do not have; every video has some."""
_NO_TIMESTAMPS = 0x80
"""Flag of FFmpeg's formats that are streams without a container (AVFMT_NOTIMESTAMPS)."""
_PREDICTED = (2, 3)
"""Types of frames that are predicted from others: P and B."""
_DEPTH = re.compile(r"(^|[^a-z])depth([^a-z]|$)", re.IGNORECASE)
_INFRARED = re.compile(r"(^|[^a-z])(ir|infrared)([^a-z]|$)", re.IGNORECASE)
_ATTACHED_PICTURE = 0x400
"""Disposition flag of FFmpeg for a cover picture (AV_DISPOSITION_ATTACHED_PIC)."""
_UNNAMED = "VideoHandler"
"""Title that FFmpeg writes for a track without one."""


@dataclass(frozen=True)
class Track:
    """A video stream of a file.

    Fields: index, among all streams of the file. number, among the video streams. title, "" for none. codec and pixels,
    FFmpeg's names. width, height, pixels. cover, whether it is a cover picture.
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
    def titled_depth(self) -> bool:
        return bool(_DEPTH.search(self.title))

    @property
    def titled_infrared(self) -> bool:
        return bool(_INFRARED.search(self.title))

    @property
    def may_be_depth(self) -> bool:
        """Return whether the pixels may be depth in millimetres."""
        return self.pixels.startswith("gray16") and not self.titled_infrared


@dataclass(frozen=True)
class ChosenTracks:
    """Fields: images and depth, the tracks that are read. others, the tracks that are not."""

    images: Track
    depth: Track | None
    others: tuple[Track, ...]


def choose_tracks(tracks: Sequence[Track]) -> ChosenTracks:
    """Choose the largest colour track, before grey and infrared, and the 16-bit grey track whose title contains depth.

    tracks: at least one.
    """
    grey = lambda track: track.pixels.startswith("gray")
    rank = lambda track: (track.titled_depth, track.titled_infrared, grey(track), -track.width * track.height)
    images = min([track for track in tracks if not track.cover] or tracks, key=rank)
    depths = (track for track in tracks if track is not images and track.titled_depth and track.may_be_depth)
    depth = next(depths, None)
    return ChosenTracks(images, depth, tuple(track for track in tracks if track not in (images, depth)))


@dataclass(frozen=True)
class VideoFile:
    """A video without ground truth, with depth if a track's title says so. Intrinsics come from a file in its folder.

    Fields: path; name; camera; rate, frames/s; count, the container's number of frames (an estimate); tracks;
    given_rate, frames/s that replaces the container's times, None to use those.
    """

    path: Path
    name: str
    camera: Camera
    rate: float
    count: int
    tracks: ChosenTracks
    has_depth: bool = False
    given_rate: float | None = None

    @classmethod
    def open(cls, path: Path, depth: bool = True) -> Self:
        """Read the header and the first frame. depth: False to ignore a track of depth.

        Raises InputError if no frame can be decoded, or the depth has another size than the images.
        """
        _check_content(path)
        tracks = _tracks(path, depth)
        with _open_stream(path, tracks.images) as stream:
            first = next((frame for _, frame in stream.frames()), None)
            if first is None:
                raise InputError(
                    f"`{path}` has no frame that can be decoded (its codec: {tracks.images.codec}): it is damaged, or "
                    "FFmpeg does not support it"
                )
            width, height = _shown_size(first)
            aspect = stream.pixel_aspect if 1 / MAX_ASPECT <= stream.pixel_aspect <= MAX_ASPECT else 1.0
            aspect = aspect if (width, height) == (first.width, first.height) else 1 / aspect  # the image is rotated
        if tracks.depth is not None and (tracks.depth.width, tracks.depth.height) != (width, height):
            raise InputError(
                f"`{path}`: the depth of {tracks.depth} must have the size of the images of {tracks.images}: register "
                "it first, or ignore it with --rgb-only"
            )
        camera = camera_from_folder(path.parent, width, height) or guess_with_warning(str(path), width, height, aspect)
        if not stream.has_times:
            warn(f"`{path}` has no times: {stream.rate:g} frames a second are assumed; `--fps` sets another rate")
        rate = stream.rate if 0 < stream.rate < MAX_RATE else _FALLBACK_RATE
        return cls(path, path.name, camera, rate, max(stream.count, 1), tracks, tracks.depth is not None)

    def __len__(self) -> int:
        return self.count

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`; skipped frames are decoded, but not converted to RGB.

        Damaged frames, and those of another size than the first, are left out, with a LeftOutWarning. A stream with
        fewer frames than its header states ends with an InputWarning.
        """
        check_selection(self.name, self.count, start, end, stride)
        return self._decode(range(start, sys.maxsize if end is None else end, stride))

    def ground_truth(self) -> Trajectory | None:
        return None

    def _decode(self, chosen: range) -> Iterator[Frame]:
        index, time = 0, -math.inf
        damaged: int | None = None  # the first frame of the current damaged part, None outside of one
        size, others = (self.camera.width, self.camera.height), []
        with self._streams() as (stream, depths):
            for failed, frame in stream.frames():
                stated = stream.time(frame)
                if failed or frame.is_corrupt:
                    damaged = index if damaged is None else damaged
                    index += self._missed(failed, stated - time, index)
                if index >= chosen.stop:
                    break
                time = self._time(index, time, stated)
                if damaged is not None and int(frame.pict_type) not in _PREDICTED and not frame.is_corrupt:
                    self._warn_of_damage(chosen, damaged, index)
                    damaged = None
                if damaged is None and index in chosen:
                    if _shown_size(frame) != size:
                        others.append(f"frame {index} is {_shown_size(frame)[0]} x {_shown_size(frame)[1]}")
                    else:
                        depth = None if depths is None else self._depth(depths, stated)
                        yield Frame(index, time, stream.rgb(frame), depth, f"{self.name}, frame {index}")
                index += 1
        if damaged is not None:
            self._warn_of_damage(chosen, damaged, index)
        if others:
            text = f"{len(others)} frames are not {size[0]} x {size[1]} pixels as the first ({others[0]})"
            warn(LeftOutWarning(f"`{self.name}`: {text}; they are skipped", len(others)))
        if index < min(chosen.stop, self.count):  # no LeftOutWarning: the count of an MKV of varying rate is a guess
            warn(f"`{self.name}` ends after {index} frames; its header states {self.count}: is the file truncated?")

    @contextmanager
    def _streams(self) -> Iterator[tuple[_Stream, NearestInTime | None]]:
        with _open_stream(self.path, self.tracks.images) as images:
            if self.tracks.depth is None or not self.has_depth:
                yield images, None
                return
            with _open_stream(self.path, self.tracks.depth) as depth:
                offset = depth.start - images.start
                yield images, NearestInTime((depth.time(frame) + offset, frame) for _, frame in depth.frames())

    def _depth(self, depths: NearestInTime, time: float) -> np.ndarray:
        """Return depth at a time of the stream, metres, NaN for none."""
        frame = depths.at(time)
        if frame is None:
            return np.full((self.camera.height, self.camera.width), np.nan, np.float32)
        return metres_of_codes(frame.to_ndarray(format="gray16le"), MILLIMETRES)

    def _missed(self, failed: int, seconds: float, index: int) -> int:
        """Return how many frames are missing before a frame: the failed packets, or more if the time gap is longer."""
        passed = round(seconds * self.rate) - 1 if math.isfinite(seconds) else 0
        return max(failed, min(passed, self.count - index - 1))

    def _time(self, index: int, previous: float, stated: float) -> float:
        """Return the container's time if it increases (phones have a varying rate), else the time by the rate."""
        if index == 0:
            return 0.0
        if self.given_rate is not None:
            return index / self.given_rate
        return stated if stated > previous else previous + 1.0 / self.rate

    def _warn_of_damage(self, chosen: range, first: int, end: int) -> None:
        if count := sum(index in chosen for index in range(first, end)):
            text = f"frames {first} to {end - 1} cannot be decoded, or are predicted from damaged frames"
            warn(LeftOutWarning(f"`{self.name}` is damaged: {text}; they are skipped", count))


class _Stream:
    """One stream of an open container of PyAV.

    rate: frames a second by the header, 0 if unknown. count: number of frames by the header or its duration, 0 if
    unknown. start: time of the first frame, seconds of the file. pixel_aspect: width of a stored pixel over its height
    (1440 x 1080 are shown as 16:9), 0 if unknown. has_times: whether the file is a container, with times of frames.
    """

    def __init__(self, container: Any, index: int) -> None:
        self._container = container
        self._stream = stream = container.streams[index]
        stream.thread_type = "AUTO"
        self._conversion = av.video.reformatter.VideoReformatter()
        self.start = float((stream.start_time or 0) * (stream.time_base or 0))
        self.rate = float(stream.guessed_rate or stream.average_rate or 0)
        self.count = int(stream.frames or round(self._seconds() * self.rate))
        self.pixel_aspect = float(stream.sample_aspect_ratio or 0)
        self.has_times = not int(container.format.flags) & _NO_TIMESTAMPS

    def frames(self) -> Iterator[tuple[int, Any]]:
        """Yield each decoded frame, and how many packets before it could not be decoded."""
        failed = 0
        with suppress(av.error.FFmpegError):  # an error of the container ends the stream: nothing after it is readable
            for packet in self._container.demux(self._stream):
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
        # For 10-bit videos FFmpeg's RGB differs from its BGR by up to 5; BGR equals what OpenCV reads. `to_ndarray` of
        # a frame would set up a new conversion each time, which takes as long as the conversion.
        image: Any = self._conversion.reformat(frame, format="bgr24", interpolation="BICUBIC").to_ndarray()
        image = np.ascontiguousarray(np.rot90(image, turns))
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)

    def _seconds(self) -> float:
        """Return the duration of the stream if Matroska states it, else that of the whole file."""
        stated = re.fullmatch(r"(\d+):(\d+):([\d.]+)", self._stream.metadata.get("DURATION", ""))
        if stated is None:
            return (self._container.duration or 0) * 1e-6
        return 3600.0 * int(stated[1]) + 60.0 * int(stated[2]) + float(stated[3]) - self.start


def _shown_size(frame: Any) -> tuple[int, int]:
    """Return width and height of a frame after it is rotated as its file states."""
    return (frame.height, frame.width) if round(frame.rotation / 90) % 2 else (frame.width, frame.height)


def _open_container(path: Path) -> Any:
    """Open a video file as a context manager; raise InputError if FFmpeg cannot."""
    try:
        return av.open(os.path.abspath(path))  # FFmpeg takes text before a `:` of a relative path for a protocol
    except (av.error.FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"`{path}` cannot be opened as a video ({reason}): it is damaged, or not a video; give an MP4, MOV, MKV, "
            "AVI or WebM"
        ) from None


@contextmanager
def _open_stream(path: Path, track: Track) -> Iterator[_Stream]:
    with _open_container(path) as container:
        yield _Stream(container, track.index)


def _tracks(path: Path, depth: bool) -> ChosenTracks:
    """Choose the tracks, with a note if there are several; raise InputError if no track is a video."""
    with _open_container(path) as container:
        streams = enumerate(container.streams.video)
        tracks = [_track(number, stream) for number, stream in streams if stream.codec_context is not None]
    if not tracks:
        raise InputError(f"`{path}` has no video stream that can be decoded")
    chosen = choose_tracks(tracks)
    chosen = chosen if depth else replace(chosen, depth=None)
    if len(tracks) < 2:
        return chosen
    beside = f", depth in millimetres of {chosen.depth}" if chosen.depth else ""
    left = ", ".join(map(str, chosen.others))
    warn(f"`{path}`: images of {chosen.images}{beside}" + (f"; not read: {left}" if left else ""), NoteWarning)
    maybe = next((track for track in chosen.others if track.may_be_depth), None)
    if depth and chosen.depth is None and maybe:
        warn(
            f"`{path}`: {maybe} may be depth (16 bits of grey), but is not used without the title DEPTH. If it is "
            f"depth in millimetres: `ffmpeg -i FILE -map 0 -c copy -metadata:s:v:{maybe.number} title=DEPTH NEW.mkv`"
        )
    return chosen


def _track(number: int, stream: Any) -> Track:
    codec = stream.codec_context
    title = stream.metadata.get("title") or stream.metadata.get("handler_name") or ""
    title = "" if title == _UNNAMED else str(title)
    cover = bool(int(stream.disposition) & _ATTACHED_PICTURE)
    return Track(stream.index, number, title, codec.name, str(codec.pix_fmt), codec.width, codec.height, cover)


def _check_content(path: Path) -> None:
    """Raise InputError for an empty file or text: FFmpeg draws letters, and opens lists of addresses (`m3u8`)."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if not _NOT_TEXT.search(head):
        raise InputError(f"`{path}` is a text file; give a folder of images or a video file")
