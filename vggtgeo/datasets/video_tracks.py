"""The tracks of a video with several: which are the images, which their depth, and how either is decoded.

OpenCV decodes the first track, whatever it shows: a small preview of an action camera, or the depth or infrared of a
recorder of a depth camera (k4arecorder writes COLOR, DEPTH and IR into one Matroska file). The package av (extra
`video`) knows all tracks, their titles and their 16 bits.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt16

from vggtgeo.models.extras import install_hint

_DEPTH = re.compile(r"(^|[^a-z])depth([^a-z]|$)", re.IGNORECASE)
_INFRARED = re.compile(r"(^|[^a-z])(ir|infrared)([^a-z]|$)", re.IGNORECASE)
_MATROSKA, _LIST_OF_TRACKS, _OF_VIDEO = b"\x1aE\xdf\xa3", b"\x16\x54\xae\x6b", b"\x83\x81\x01"
"""Marks of EBML: the head of a file, the element `Tracks`, and a `TrackType` of video."""
_HANDLER = re.compile(rb"hdlr.{8}vide", re.DOTALL)
_MOST_HEAD = 1 << 20
DELAY = 0.02
"""Seconds between an image and its depth."""


@dataclass(frozen=True)
class Track:
    """index: among all streams of the file. number: among those of video. title: "" for none. codec, pixels: FFmpeg's
    names. cover: whether it is a single picture for a list of files.
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
        """Whether it may be depth in millimetres, by its pixels."""
        return self.pixels.startswith("gray16")

    @property
    def is_depth(self) -> bool:
        """Whether its title says so."""
        return bool(_DEPTH.search(self.title))


@dataclass(frozen=True)
class ChosenTracks:
    """images, depth: the tracks that are read. others: those that are not."""

    images: Track
    depth: Track | None
    others: tuple[Track, ...]

    @property
    def maybe_depth(self) -> tuple[Track, ...]:
        """Those that are not read, could be depth, and do not say what they are."""
        unsaid = (one for one in self.others if one.has_16_bits_of_grey and not _INFRARED.search(one.title))
        return tuple(unsaid) if self.depth is None else ()


def choose_tracks(tracks: Sequence[Track]) -> ChosenTracks:
    """Of several tracks of video: the largest in colour, before grey and infrared, and the 16 bits of grey whose title
    says depth. tracks: at least one.
    """
    films = [track for track in tracks if not track.cover] or list(tracks)
    depth = next((track for track in films if track.is_depth and track.has_16_bits_of_grey), None)
    rank = lambda track: (
        track.is_depth,
        bool(_INFRARED.search(track.title)),
        track.pixels.startswith("gray"),
        -track.width * track.height,
    )
    images = min(films, key=rank)
    depth = None if depth is images else depth
    return ChosenTracks(images, depth, tuple(track for track in tracks if track not in (images, depth)))


def read_tracks(path: str) -> tuple[Track, ...]:
    """The tracks of video of a file; () where it cannot be opened, or the package av is not installed."""
    try:
        import av
    except ImportError:
        return ()
    try:
        with av.open(path) as container:
            # A damaged file may name a codec that does not exist: no decoder, which the types of av leave out.
            streams: Iterable[tuple[int, Any]] = enumerate(container.streams.video)
            return tuple(_track(number, stream) for number, stream in streams if stream.codec_context is not None)
    except (av.error.FFmpegError, OSError, ValueError):  # OpenCV says what is wrong
        return ()


def _track(number: int, stream: Any) -> Track:
    codec = stream.codec_context
    title = stream.metadata.get("title") or stream.metadata.get("handler_name") or ""
    title = "" if title == _UNNAMED else str(title)
    cover = bool(int(stream.disposition) & _ATTACHED_PICTURE)
    return Track(stream.index, number, title, codec.name, str(codec.pix_fmt), codec.width, codec.height, cover)


_ATTACHED_PICTURE = 0x400
_UNNAMED = "VideoHandler"
"""Of tracks that FFmpeg wrote without a title."""


def said_without_package(path: Path) -> str:
    """A sentence about several tracks of a Matroska or MP4 file, where the package that reads them is not installed."""
    try:
        import av  # noqa: F401 - whether it is there

        return ""
    except ImportError:
        count = _count_of_tracks(path)
    if count < 2:
        return ""
    return f"`{path}` has {count} tracks of video; the first is read, whatever it shows: {install_hint('video')}"


def _count_of_tracks(path: Path) -> int:
    """By the marks of the two containers; 0 for others."""
    with path.open("rb") as file:
        head = file.read(_MOST_HEAD)
        if head.startswith(_MATROSKA):
            return head.partition(_LIST_OF_TRACKS)[2].count(_OF_VIDEO)
        place, size = 0, path.stat().st_size
        while place + 16 <= size:
            file.seek(place)
            length, name, longer = int.from_bytes(file.read(4)), file.read(4), int.from_bytes(file.read(8))
            length = longer if length == 1 else length or size - place
            if name == b"moov":
                file.seek(place)
                return len(_HANDLER.findall(file.read(min(length, 64 * _MOST_HEAD))))
            if length < 8:
                break
            place += length
    return 0


class TrackCapture:
    """One track, by the calls of `cv2.VideoCapture` that a video is read with."""

    def __init__(self, path: str, index: int) -> None:
        """path, index: of the file and the stream in it."""
        import av

        self._errors = av.error.FFmpegError
        self._container = av.open(path)
        stream: Any = self._container.streams[index]  # of video, which its type does not say
        self._stream = stream
        self._stream.thread_type = "AUTO"
        self._frames = self._decoded()
        self._frame: Any = None
        self.start = float(self._stream.start_time or 0) * float(self._stream.time_base)

    def _decoded(self) -> Iterator[Any]:
        """The frames, None for data that are damaged."""
        for packet in self._container.demux(self._stream):
            try:
                yield from packet.decode()
            except self._errors:
                yield None

    def grab(self) -> bool:
        """Whether the next frame can be decoded; behind one that is damaged there may be others."""
        try:
            self._frame = next(self._frames, None)
        except self._errors:
            self._frame = None
        return self._frame is not None

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """The frame, BGR, turned as its file says."""
        if self._frame is None:
            return False, None
        image = self._frame.to_ndarray(format="bgr24")
        return True, np.ascontiguousarray(np.rot90(image, int(self._frame.rotation) // 90))

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Both."""
        self.grab()
        return self.retrieve()

    def get(self, key: int) -> float:
        """A property of the file or the frame, as OpenCV has it; 0 for those that are not known."""
        stream, frame = self._stream, self._frame
        rate = float(stream.average_rate or stream.guessed_rate or 0)
        if key == cv2.CAP_PROP_FPS:
            return rate
        if key == cv2.CAP_PROP_FRAME_COUNT:
            return float(stream.frames or round(self._seconds() * rate))
        if key in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN):
            aspect = stream.sample_aspect_ratio or 0
            return float(getattr(aspect, "numerator" if key == cv2.CAP_PROP_SAR_NUM else "denominator", 0))
        if frame is None:
            return 0.0
        if key == cv2.CAP_PROP_POS_MSEC:
            return 1e3 * (float(frame.time or 0.0) - self.start)
        if key == cv2.CAP_PROP_FRAME_TYPE:
            return float(ord("?IPB"[int(frame.pict_type)]) if int(frame.pict_type) in (1, 2, 3) else 0)
        of_frame = {cv2.CAP_PROP_PTS: frame.pts, cv2.CAP_PROP_ORIENTATION_META: frame.rotation}
        return float(of_frame.get(key) or 0)

    def _seconds(self) -> float:
        """Of the track, as Matroska states it, else of the whole file."""
        stated = re.fullmatch(r"(\d+):(\d+):([\d.]+)", self._stream.metadata.get("DURATION", ""))
        if stated is None:
            return (self._container.duration or 0) * 1e-6
        return 3600.0 * int(stated[1]) + 60.0 * int(stated[2]) + float(stated[3]) - self.start

    def codes(self) -> UInt16[np.ndarray, "h w"]:
        """The numbers of the frame, of a track of 16 bits of grey."""
        return np.asarray(self._frame.to_ndarray(format="gray16le"))

    def release(self) -> None:
        """Closes the file."""
        self._container.close()


class DepthTrack:
    """Depth of a track, asked for by rising times."""

    def __init__(self, path: str, index: int, start: float) -> None:
        """path, index: of the file and the stream in it. start: the time of the images' first, seconds of the file."""
        self._capture = TrackCapture(path, index)
        self._later = self._capture.start - start
        self._read = self._codes()
        self._near = [next(self._read, None)]

    def at(self, time: float) -> UInt16[np.ndarray, "h w"] | None:
        """The codes nearest to a time, seconds behind the images' first; None where none is within `DELAY`."""
        while self._near[-1] is not None and self._near[-1][0] < time:
            self._near = [self._near[-1], next(self._read, None)]
        known = [one for one in self._near if one is not None and abs(one[0] - time) <= DELAY]
        return min(known, key=lambda one: abs(one[0] - time))[1] if known else None

    def close(self) -> None:
        """Closes the file."""
        self._capture.release()

    def _codes(self) -> Iterator[tuple[float, np.ndarray]]:
        while self._capture.grab():
            yield self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3 + self._later, self._capture.codes()


@contextmanager
def open_depth(path: str, track: Track | None, start: float) -> Iterator[DepthTrack | None]:
    """See `DepthTrack`; None where there is no track."""
    depth = None if track is None else DepthTrack(path, track.index, start)
    try:
        yield depth
    finally:
        if depth is not None:
            depth.close()
