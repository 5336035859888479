"""The sizes of a video's pictures as its codec writes them.

OpenCV scales every picture to the size of the first, without a word. The pictures that stand alone carry their size:
their data are read undecoded beside the frames, and where a header is new, a decoder of its own tells the size.
"""

import io
import re
import struct
from collections.abc import Iterator
from contextlib import suppress

import cv2
import numpy as np

from vggtgeo.io.errors import InputWarning, LeftOutWarning

Size = tuple[int, int]
_BEGIN, _END = rb"\x00\x00\x01", rb".*?\x00\x00[\x00\x01]"
_H264, _H265, _MPEG = _BEGIN + rb"[\x07\x27\x47\x67]" + _END, _BEGIN + rb"\x42" + _END, _BEGIN + rb"\xb3.{8}"
_VP8, _VP9, _JPEG = rb"\A.{3}\x9d\x01\x2a.{4}", rb"\A.{12}", rb"\xff[\xc0-\xc2].{7}"
_HEADERS = {
    **dict.fromkeys((b"h264", b"avc1", b"x264"), _H264),
    **dict.fromkeys((b"hevc", b"hvc1", b"hev1"), _H265),
    **dict.fromkeys((b"mpg1", b"mpg2", b"pim1"), _MPEG),
    b"mjpg": _JPEG,
    b"vp80": _VP8,
    b"vp90": _VP9,
}
"""What tells the size, in the data of a picture that stands alone, by the letters of the codec. Other codecs (MPEG-4,
ProRes, DV) leave the size to the container, which states one.
"""
_MOST_AHEAD = 100
"""Undecoded pictures that are read for one frame: VP8 has some that are never shown."""

_SAME_ASPECT = 0.01
"""Of the proportions: codecs want even sides."""


class PictureSizes:
    """Walks along a video that is being decoded, and knows the size that each frame had before it was scaled."""

    def __init__(self, path: str, fourcc: bytes) -> None:
        """path: as OpenCV takes it. fourcc: the codec's four letters."""
        self._fourcc = fourcc
        self._header = re.compile(_HEADERS.get(fourcc.lower(), rb"\A(?!)"), re.DOTALL)
        known = fourcc.lower() in _HEADERS
        self._packets = cv2.VideoCapture(path, cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1]) if known else None
        self._sizes: dict[bytes, Size | None] = {}
        self._coming: list[tuple[float, Size]] = []
        self._now: Size | None = None
        self._first: Size | None = None
        self._others: dict[bool, list[tuple[int, Size]]] = {True: [], False: []}

    def fits(self, index: int, time: float, chosen: bool) -> bool:
        """Whether a frame can be used as OpenCV hands it back: it had the first's size, or its aspect.

        index: its number; frames are asked in their order. time: in the container's units (`CAP_PROP_PTS`). chosen:
        whether it is wanted, and counts where it does not fit.
        """
        for _ in range(_MOST_AHEAD):
            if self._packets is None or self._read() >= time:
                break
        while self._coming and self._coming[0][0] <= time:
            self._now = self._coming.pop(0)[1]
            self._first = self._first or self._now
        if self._now is None or self._first is None or self._now == self._first:
            return True
        fits = abs(self._now[0] * self._first[1] / (self._now[1] * self._first[0]) - 1) <= _SAME_ASPECT
        if chosen:
            self._others[fits].append((index, self._now))
        return fits

    def warnings(self, name: str) -> Iterator[InputWarning]:
        """What is to be said of the video of this name when all its frames were asked."""
        for fits, others in self._others.items():
            if others and self._first is not None:
                index, (width, height) = others[0]
                text = (
                    f"`{name}` changes the size of its pictures: {len(others)} frames, {index} first ({width} x "
                    f"{height} pixels), are not {self._first[0]} x {self._first[1]} as the first"
                )
                yield (
                    InputWarning(f"{text}; they are scaled to that")
                    if fits
                    else LeftOutWarning(f"{text}, and have other proportions; they are skipped", len(others))
                )

    def close(self) -> None:
        """Closes the file."""
        if self._packets is not None:
            self._packets.release()
            self._packets = None

    def _read(self) -> float:
        """Reads the next picture's data; returns its time."""
        data: np.ndarray | None = None
        if self._packets is not None:
            with suppress(cv2.error):
                data = self._packets.read()[1]
        if self._packets is None or data is None:
            self.close()
            return np.inf
        time = float(self._packets.get(cv2.CAP_PROP_PTS))
        if self._packets.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME):
            content = data.tobytes()
            found = self._header.search(content)
            if found and found[0] not in self._sizes:
                self._sizes[found[0]] = _decoded_size(self._fourcc, content)
            size = self._sizes.get(found[0]) if found else None
            if size is not None:
                self._coming.append((time, size))
        return time


def _decoded_size(fourcc: bytes, content: bytes) -> Size | None:
    """The size of a picture that is alone in a file."""
    if fourcc.upper() in (b"VP80", b"VP90"):  # the container must state VP8's size, or it is scaled to that, too
        width, height = (side & 0x3FFF for side in struct.unpack("<HH", content[6:10]))
        if fourcc.upper() == b"VP80":
            return width, height
        header = struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, b"VP90", 16, 16, 10, 1, 1, 0)
        content = header + struct.pack("<IQ", len(content), 0) + content
    source = io.BytesIO(content)  # OpenCV keeps no reference of its own
    try:
        picture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, [])
    except cv2.error:
        return None
    size = int(picture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(picture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    picture.release()
    return size if min(size) > 0 else None
