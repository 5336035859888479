"""The streams of a video file with several: which are the images, which their depth.

Action cameras write a small preview beside the recording; k4arecorder writes COLOR, DEPTH and IR into one Matroska
file.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

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
