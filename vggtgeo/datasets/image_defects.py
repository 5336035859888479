"""What is wrong with the bytes of an image file, where its decoder would hand back something without a word.

A header may declare any size, and the decoder takes memory for it before it looks at the data. What libjpeg-turbo warns
of it does not refuse: missing blocks become grey, and those after a damaged byte come to lie elsewhere.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator

from vggtgeo.datasets import image_sizes

MOST_PIXELS = 100_000_000
"""Pixels of an image that are decoded: 0.3 GB."""
_OTHER_FORMATS = (b"GIF8", b"\xff\x4f\xff\x51", b"\xff\x0a")
_OTHER_BOXES = (b"jP  ", b"ftyp", b"JXL ")
"""OpenCV takes them by their content. Some hundred bytes of them may declare gigabytes of pixels, at places of the file
that nobody here reads, and their own kind of turning is applied without a word."""
_RARE_FORMATS = {b"qoif": "QOI", b"II\xbc": "JPEG XR", b"\xff\xd8\xff\xf7": "JPEG-LS"}
_LFS_POINTER = b"version https://git-lfs"
_LEFT_OVER = re.compile(r"(\d+) extraneous bytes before marker 0xd9")
_MOST_LEFT_OVER = 4
_MOST_OF_A_BYTE = 512
"""Pixels: of each 64 of them a Huffman-coded JPEG has one bit at least."""


def defect(content: bytes) -> str:
    """What is wrong with a file before it is decoded, as the end of a sentence; empty for nothing."""
    if not content:
        return "is empty"
    if content.startswith(b"\x89PNG") and content.rfind(b"IEND") < 0:
        return "is cut off: the PNG has no end"
    if content.startswith(b"\x89PNG") and not _chunks_fit(content):
        return "is damaged: a part of the PNG declares more bytes than the file has"
    rare = next((name for begin, name in _RARE_FORMATS.items() if content.startswith(begin)), "")
    if rare:
        return f"is a {rare}, which is not read: convert it to PNG or JPEG"
    bits = _jpeg_bits(content)
    if bits not in (0, 8):
        return f"is a JPEG of {bits} bits; those of 8 are read: convert it to PNG"
    if content.startswith(b"\xff\xd8") and content.rfind(b"\xff\xd9") < _start_of_scan(content):
        return "is cut off: the JPEG has no end"
    if _lacks_scans(content):
        return "is cut off: scans of the progressive JPEG are missing"
    if content.startswith(_OTHER_FORMATS) or content[4:8] in _OTHER_BOXES:
        return "is a GIF, JPEG 2000, JPEG XL, AVIF or HEIC, whatever its name: convert it to PNG or JPEG"
    if content.startswith(_LFS_POINTER):
        return "is a Git LFS pointer, not the image itself: fetch it with `git lfs pull`"
    width, height = declared_size(content)
    if width * height > MOST_PIXELS:
        return f"declares {width} x {height} pixels, more than {MOST_PIXELS // 10**6} million: not decoded"
    if bits and width * height > _MOST_OF_A_BYTE * len(content):
        return f"is cut off: its {len(content)} bytes are too few for a JPEG of {width} x {height} pixels"
    return ""


def decoding_defect(message: str) -> str:
    """What libjpeg-turbo's first warning or error says of a JPEG, as the end of a sentence; empty where it says nothing
    of damage. Encoders of some cameras leave a few bytes between the data and the end mark: those harm nothing.
    """
    left = _LEFT_OVER.search(message)
    if left is not None and int(left[1]) <= _MOST_LEFT_OVER:
        return ""
    if message.startswith(("Corrupt JPEG data", "Premature end")):
        return f"is damaged, or cut off: a part of it would be grey or in a wrong place ({message})"
    return ""


def _jpeg_bits(content: bytes) -> int:
    """Bits of a JPEG's values by its header; 0 of what is none."""
    frames = (part for marker, part in jpeg_segments(content) if marker in (0xC0, 0xC1, 0xC2) and part)
    return next(frames, b"\0")[0]


def declared_size(content: bytes) -> tuple[int, int]:
    """Width and height that the header of an image declares; (0, 0) for what is none that is known."""
    if content.startswith(b"\x89PNG") and len(content) >= 24:
        width, height = struct.unpack(">II", content[16:24])
        return width, height
    for marker, part in jpeg_segments(content):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and len(part) >= 5:
            height, width = struct.unpack(">HH", part[1:5])
            return width, height
    return image_sizes.declared_size(content)


def png_chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of each chunk of a PNG that lies in the file, its end the last."""
    position, kind = 8, b""
    while position + 8 <= len(content) and kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", content, position)
        if position + 12 + length > len(content):
            return
        yield kind, content[position + 8 : position + 8 + length]
        position += 12 + length


def _chunks_fit(content: bytes) -> bool:
    """Whether each chunk of a PNG up to its end lies in the file: the decoder takes memory for what one declares."""
    return any(kind == b"IEND" for kind, _ in png_chunks(content))


def jpeg_segments(content: bytes) -> list[tuple[int, bytes]]:
    """Marker and content of each segment of a JPEG before its image data."""
    found, position = [], 2
    while content.startswith(b"\xff\xd8") and position + 4 <= len(content) and content[position] == 0xFF:
        marker, length = content[position + 1], int.from_bytes(content[position + 2 : position + 4])
        if marker == 0xDA:
            break
        found.append((marker, content[position + 4 : position + 2 + length]))
        position += 2 + length
    return found


def _lacks_scans(content: bytes) -> bool:
    """Whether a progressive JPEG ends before each component has its DC and all 63 AC coefficients to the last bit."""
    frame = next((part for marker, part in jpeg_segments(content) if marker == 0xC2), None)
    if frame is None or len(frame) < 6:
        return False
    missing = {component: set(range(64)) for component in frame[6 : 6 + 3 * frame[5] : 3]}
    position = content.find(b"\xff\xda")
    while position >= 0 and position + 5 < len(content):  # in the data of a scan, ff is followed by 00
        count = content[position + 4]
        after = position + 5 + 2 * count
        if after + 3 > len(content):
            break
        first, last, bits = content[after : after + 3]
        if bits & 15 == 0:
            for component in content[position + 5 : after : 2]:
                missing.get(component, set()).difference_update(range(first, last + 1))
        position = content.find(b"\xff\xda", after)
    return any(missing.values())


def _start_of_scan(content: bytes) -> int:
    """Where a JPEG's image data begin; its length where there are none. Thumbnails before it have ends of their own."""
    position = 2
    while position + 4 <= len(content) and content[position] == 0xFF:
        if content[position + 1] == 0xDA:
            return position
        position += 2 + int.from_bytes(content[position + 2 : position + 4])
    return len(content)
