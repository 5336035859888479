"""A video file, decoded frame by frame by OpenCV; one with several tracks by the package av, `video_tracks.py`."""

import math
import os
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.image_files import MILLIMETRES, metres_of_codes
from vggtgeo.datasets.intrinsics import MOST_ASPECT, camera_from_folder, guess_with_warning
from vggtgeo.datasets.picture_sizes import PictureSizes
from vggtgeo.datasets.video_tracks import (
    ChosenTracks,
    DepthTrack,
    Track,
    TrackCapture,
    choose_tracks,
    open_depth,
    read_tracks,
    said_without_package,
)
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning, NoteWarning

_FALLBACK_RATE = 30.0
_LOOKED_AT = 4096
_MOST_MISSED = 1000
"""Frames in a row that are tried: a damaged header may declare 10^9 where the file ends."""
_MADE_OF_OTHERS = tuple(map(ord, "PB"))
_MOST_ALIKE = 6
"""Frames that are the same to the bit, one behind the other."""
_CONVERT = "`ffmpeg -i FILE -c:v libx264 NEW.mp4` makes one that it does"
_STREAMS = (b"\xff\xd8\xff", b"\0\0\1", b"\0\0\0\1")
"""Begins of frames of JPEG, MPEG and H.264 that lie one behind the other, without their times."""
_CONTAINERS = (b"\0\0\1\xba", b"\x1aE\xdf\xa3", b"OggS", b"RIFF", b"FLV", b"G", b"0&\xb2u", b"nut/", b"YUV4")
"""Begins of containers, which state times where they state no count: MPEG program stream, Matroska and WebM, Ogg, AVI,
FLV, MPEG transport stream, ASF, NUT, YUV4MPEG2."""
_BOXES = (b"ftyp", b"styp", b"moov", b"moof", b"mdat", b"free", b"skip", b"wide")
"""What an MP4 or a MOV begins with, behind four bytes."""
FASTEST = 1000
"""Frames a second that a header may state."""
_NO_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
"""Control characters other than those of text and terminals; no container of videos is without them."""


@dataclass(frozen=True)
class VideoFile:
    """A video without truth; with depth where a track of it says so. Intrinsics come from a file in the video's folder.

    Fields: path; name; camera; rate, frames/s; count, the container's number of frames (an estimate);
    given_rate, frames/s in place of the container's times; tracks, those that are read of several.
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
        """Reads the header and the first frame. depth: False to leave a track of depth alone.

        Raises:
            InputError: no video can be decoded, or its depth is of another size than its images.

        """
        tracks = _tracks(path, depth)
        with _capture(path, tracks) as capture:
            readable, image = _decoded(capture.read)
            if not readable or image is None or not image.size:  # a damaged stream may be decoded to nothing
                raise InputError(
                    f"`{path}` has no frame that can be decoded (its codec: {_codec(capture)}): it is damaged, or of a "
                    f"kind that OpenCV does not know; {_CONVERT}"
                )
            rate = capture.get(cv2.CAP_PROP_FPS)
            stated = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            count = int(stated) if math.isfinite(stated) else 1
            aspect = _pixel_aspect(capture)
        height, width = image.shape[:2]
        if tracks is not None and tracks.depth is not None:
            _check_depth(path, tracks, tracks.depth, (width, height))
        camera = camera_from_folder(path.parent, width, height) or guess_with_warning(str(path), width, height, aspect)
        known_rate = math.isfinite(rate) and 0 < rate < FASTEST
        if not stated > 0 and (what := _without_container(path)):  # a browser's recording states no count, but times
            _warn(InputWarning(f"`{path}` {what}; {rate:g} frames a second are taken: give `--fps` if it has others"))
        if math.isfinite(rate) and rate > FASTEST:
            _warn(InputWarning(f"`{path}` states {rate:g} frames a second: give `--fps` if that is not its rate"))
        has_depth = tracks is not None and tracks.depth is not None
        rate = rate if known_rate else _FALLBACK_RATE
        return cls(path, path.name, camera, rate, max(count, 1), has_depth, None, tracks)

    def __len__(self) -> int:
        return self.count

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`; frames that are skipped are not converted. A stream that ends before its
        container says so ends with an InputWarning.
        """
        check_selection(self.name, self.count, start, end, stride)
        return self._decode(start, end, stride)

    def ground_truth(self) -> Trajectory | None:
        """None."""
        return None

    def _decode(self, start: int, end: int | None, stride: int) -> Iterator[Frame]:
        time, index, jumped = -math.inf, 0, False
        damaged: int | None = None  # the first frame of those that cannot be decoded, while they last
        still = _Still(self.name)
        with (
            _capture(self.path, self.tracks) as capture,
            self._sizes(capture) as sizes,
            open_depth(_ffmpeg_name(self.path), self._depth_track, getattr(capture, "start", 0.0)) as depths,
        ):
            while end is None or index < end:
                missed = self._missed(capture, self.count - index - 1)
                if missed is None:
                    break
                damaged = index if missed and damaged is None else damaged
                index += missed
                jumped = jumped or self._tell_jump(capture, index, time)
                time = self._time(capture, index, time)
                if damaged is not None and _stands_alone(capture):
                    self._tell_damaged(damaged, index, _chosen(start, end, stride, damaged, index))
                    damaged = None
                chosen = index >= start and (end is None or index < end) and (index - start) % stride == 0
                fits = sizes.fits(index, capture.get(cv2.CAP_PROP_PTS), chosen)
                if chosen and fits and damaged is None:
                    readable, image = _decoded(capture.retrieve)
                    wrong = self._wrong(image if readable else None)
                    if wrong:
                        _warn(LeftOutWarning(f"`{self.name}`: frame {index} {wrong}; it is skipped"))
                    else:
                        colour = cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)
                        still.see(index, colour)
                        depth = None if depths is None else self._depth(depths, capture)
                        yield Frame(index, time, colour, depth, f"{self.name}, frame {index}")
                index += 1
        if damaged is not None:
            self._tell_damaged(damaged, index, _chosen(start, end, stride, damaged, index))
        wanted = self.count if end is None else min(end, self.count)
        if index < wanted:
            counts = f"ends after {index} frames; its header says {self.count}"
            text = f"`{self.name}` {counts}: is the file cut off, or damaged, or was it trimmed?"
            _warn(InputWarning(text))  # not as left out: where the rate varies, the header of an MKV only guesses

    @property
    def _depth_track(self) -> Track | None:
        return self.tracks.depth if self.tracks is not None and self.has_depth else None

    def _depth(self, depths: DepthTrack, capture: Any) -> np.ndarray:
        """Depth of the frame in hand, metres, NaN for none."""
        shape = self.camera.height, self.camera.width
        codes = depths.at(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3)
        return np.full(shape, np.nan, np.float32) if codes is None else metres_of_codes(codes, MILLIMETRES)

    @contextmanager
    def _sizes(self, capture: Any) -> Iterator[PictureSizes]:
        """The sizes of the pictures before OpenCV scaled them; tells of those that are others than the first's."""
        letters = _letters(capture) if self.tracks is None else b""  # those of the first track are others' there
        sizes = PictureSizes(_ffmpeg_name(self.path), letters)
        try:
            yield sizes
        finally:
            sizes.close()
        for warning in sizes.warnings(self.name):
            _warn(warning)

    def _missed(self, capture: Any, more: int) -> int | None:
        """Frames that cannot be decoded before the next one, which is grabbed; None at the end.

        OpenCV answers damaged data as it answers the end, but goes on behind them when it is asked again. It passes
        some without a word, so the times are asked, too. more: frames that the container says are behind the next one.
        """
        before = capture.get(cv2.CAP_PROP_POS_MSEC)
        attempts = range(1 + min(max(more, 0), _MOST_MISSED))
        missed = next((number for number in attempts if _grabbed(capture)), None)
        if not missed:
            return missed
        passed = (capture.get(cv2.CAP_PROP_POS_MSEC) - before) * 1e-3 * self.rate - 1.0
        return max(missed, min(more, round(passed))) if math.isfinite(passed) else missed

    def _tell_damaged(self, first: int, behind: int, chosen: int) -> None:
        """Of the frames from `first` to before `behind`, so many were chosen."""
        if chosen:
            text = f"`{self.name}` is damaged: frames {first} to {behind - 1} cannot be decoded, or are made of such"
            _warn(LeftOutWarning(f"{text}; they are skipped", chosen))

    def _wrong(self, image: np.ndarray | None) -> str:
        """What is wrong with a decoded frame, as the end of a sentence; empty for nothing."""
        if image is None or not image.size:
            return "cannot be decoded"
        height, width = image.shape[:2]
        size = (self.camera.width, self.camera.height)
        return "" if (width, height) == size else f"is {width} x {height} pixels, the first {size[0]} x {size[1]}"

    def _time(self, capture: Any, index: int, previous: float) -> float:
        """The container's time where it increases (frames of phones come at a varying rate), else by the rate."""
        if index == 0:
            return 0.0
        if self.given_rate is not None:
            return index / self.given_rate
        time = capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3
        return time if math.isfinite(time) and time > previous else previous + 1.0 / self.rate

    def _tell_jump(self, capture: Any, index: int, before: float) -> bool:
        """Whether a container's time is before that of the last frame, which is told; 0 is that of frames without."""
        time = capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3
        back = self.given_rate is None and 0 < time < before - 1.0 / self.rate
        if back:
            _warn(
                InputWarning(
                    f"`{self.name}`: the time goes back from {before:.3f} to {time:.3f} s at frame {index}: are these "
                    "recordings that were joined? Give each by itself"
                )
            )
        return back


class _Still:
    """Tells of frames that are the same to the bit, which no camera's noise is: where OpenCV 5 cannot convert a frame,
    it answers with what was in its memory, and says that all is well.
    """

    def __init__(self, name: str) -> None:
        self._name, self._last, self._alike, self._told = name, np.zeros((0, 0, 3), np.uint8), [0], False

    def see(self, index: int, image: np.ndarray) -> None:
        """index, image: of the next frame that is used."""
        same = np.array_equal(image[::16], self._last[::16]) and np.array_equal(image, self._last)
        self._alike = [*self._alike, index] if same and not self._told else [index]
        self._last = image
        if len(self._alike) == _MOST_ALIKE:
            self._told = True
            _warn(
                InputWarning(
                    f"`{self._name}`: its frames {self._alike[0]} to {index} are one picture, bit by bit: nothing "
                    "moves there, or they are interlaced, which OpenCV does not decode; `ffmpeg -i FILE -vf yadif "
                    "NEW.mp4` makes a video of whole pictures"
                )
            )


def _pixel_aspect(capture: Any) -> float:
    """Width of a pixel over its height, as the container says (1440 x 1080 are shown as 16:9); 1 where it says none, or
    what is none.
    """
    across, down = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    if capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 == 90:  # OpenCV has turned the frames, not these
        across, down = down, across
    known = across > 0 and down > 0 and 1 / MOST_ASPECT <= across / down <= MOST_ASPECT
    return across / down if known else 1.0


def _without_container(path: Path) -> str:
    """What is said of a file whose frames lie in no container, which would state their times; "" for others."""
    with path.open("rb") as file:
        head = file.read(8)
    if head.startswith(_CONTAINERS) or head[4:] in _BOXES:
        return ""
    if head.startswith(_STREAMS):
        return "is a stream that states neither its times nor how many frames it has"
    return "does not begin as a video does (is its header damaged?), and what was found in it has no times"


def _codec(capture: Any) -> str:
    """The four letters of a codec."""
    letters = _letters(capture).decode("ascii", "replace")
    return letters if letters.isprintable() else "not known"


def _letters(capture: Any) -> bytes:
    return (int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF).to_bytes(4, "little")


def _stands_alone(capture: Any) -> bool:
    """Whether the frame is decoded from its own data: others, after damaged ones, are made of what is not there."""
    return int(capture.get(cv2.CAP_PROP_FRAME_TYPE)) not in _MADE_OF_OTHERS


def _chosen(start: int, end: int | None, stride: int, first: int, behind: int) -> int:
    """How many frames of a selection lie from `first` to before `behind`."""
    steps = max(0, -((start - first) // stride))
    return len(range(start + steps * stride, behind if end is None else min(end, behind), stride))


def _grabbed(capture: Any) -> bool:
    """Whether there is a further frame; a container that OpenCV itself reads may end in an exception."""
    try:
        return bool(capture.grab())
    except cv2.error:
        return False


def _decoded(decode: Callable[[], tuple[bool, np.ndarray | None]]) -> tuple[bool, np.ndarray | None]:
    try:
        return decode()
    except cv2.error:
        return False, None


def _is_text(path: Path) -> bool:
    """Whether a file is text: FFmpeg draws the letters of some as pictures, and others are lists of files and addresses
    that it would open (`ffconcat`, `m3u8`, `sdp`).
    """
    with path.open("rb") as file:
        start = file.read(_LOOKED_AT)
    return bool(start) and not _NO_TEXT.search(start)


def _tracks(path: Path, depth: bool) -> ChosenTracks | None:
    """Those that are read, told; None of a video whose first track is all that there is to be read of it."""
    _check_content(path)
    tracks = read_tracks(_ffmpeg_name(path))
    if sentence := said_without_package(path):
        _warn(InputWarning(sentence))
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
                f"`{path}`: {', '.join(map(str, maybe))} may be depth, by 16 bits of grey, and no title says so: not "
                f"used; `ffmpeg -i FILE -map 0 -c copy -metadata:s:v:{maybe[0].number} title=DEPTH NEW.mkv` says that "
                "it is depth in millimetres"
            )
        )
    first = next((track for track in tracks if not track.cover), tracks[0])
    return None if chosen.images is first is tracks[0] and chosen.depth is None else chosen


def _check_depth(path: Path, chosen: ChosenTracks, depth: Track, size: tuple[int, int]) -> None:
    if (depth.width, depth.height) != size:
        raise InputError(
            f"`{path}`: the depth of {depth} is that of another camera than the images of {chosen.images}, and cannot "
            "be registered to them: the file does not tell how the two lie in a way that is read; register it first "
            "(Azure Kinect: `k4a_transformation_depth_image_to_color_camera`), or leave it out with --rgb-only"
        )


def _check_content(path: Path) -> None:
    if _is_text(path):
        raise InputError(f"`{path}` is a text file; give a folder of images or a video file")
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"`{path}` is empty; copy or record it again")


@contextmanager
def _capture(path: Path, tracks: ChosenTracks | None = None) -> Iterator[Any]:
    if tracks is not None:
        track = TrackCapture(_ffmpeg_name(path), tracks.images.index)
        try:
            yield track
        finally:
            track.release()
        return
    try:
        capture = cv2.VideoCapture(_ffmpeg_name(path))
    except cv2.error as error:
        raise InputError(f"`{path}` cannot be opened as a video: {error.err}") from None
    try:
        if not capture.isOpened():
            raise InputError(
                f"`{path}` cannot be opened as a video: it is damaged, or no video that OpenCV knows; if other "
                f"programs play it, {_CONVERT}"
            )
        yield capture
    finally:
        capture.release()


def _ffmpeg_name(path: Path) -> str:
    """FFmpeg takes what is before a `:` for a protocol, where a path does not begin with `/`."""
    try:
        return os.path.abspath(path).encode().decode()
    except UnicodeError:  # OpenCV 5 ends the process over such a name
        raise InputError(f"the name of `{path}` is no UTF-8, which OpenCV needs; rename the video") from None


def _warn(warning: InputWarning) -> None:
    warnings.warn(warning, stacklevel=3)
