"""How an image file asks to be turned when it is shown, and a TIFF that does not ask.

Images are used as they are stored, whatever their format: intrinsics and depth are those of the stored pixels. OpenCV
can be told so for JPEG, PNG and WebP; a TIFF it turns all the same.
"""

from __future__ import annotations

import struct
from pathlib import Path

from vggtgeo.datasets.image_defects import jpeg_segments, png_chunks
from vggtgeo.datasets.tiff_tags import STARTS, tiff_tags

_ORIENTATION = 0x0112


def orientation(content: bytes) -> int:
    """The EXIF orientation of a JPEG, PNG, WebP or TIFF, 1 to 8; 1, as it is stored, where it has none."""
    tag = tiff_tags(_exif(content)).get(_ORIENTATION)
    return tag.value if tag is not None and 1 <= tag.value <= 8 else 1


def not_turned(name: Path, orientation: int) -> str:
    """What a user is told of a file that asks to be turned."""
    return (
        f"`{name}` asks to be turned (EXIF orientation {orientation}): images are used as they are stored, and "
        "intrinsics and depth must be those of the stored images"
    )


def as_stored(content: bytes) -> bytes:
    """The file, and where it is a TIFF that asks to be turned, one that does not."""
    if not content.startswith(STARTS) or orientation(content) == 1:
        return content
    tag = tiff_tags(content)[_ORIENTATION]
    changed = bytearray(content)
    struct.pack_into(tag.format, changed, tag.place, 1)
    return bytes(changed)


def _exif(content: bytes) -> bytes:
    """The part of a file that is a TIFF's directory."""
    if content.startswith(b"\xff\xd8"):
        parts = (part[6:] for mark, part in jpeg_segments(content) if mark == 0xE1 and part.startswith(b"Exif\0\0"))
    elif content.startswith(b"\x89PNG"):
        parts = (part for kind, part in png_chunks(content) if kind == b"eXIf")
    elif content.startswith(b"RIFF") and content[8:12] == b"WEBP":
        parts = (part.removeprefix(b"Exif\0\0") for kind, part in _webp_chunks(content) if kind == b"EXIF")
    else:
        return content
    return next(parts, b"")


def _webp_chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    found, position = [], 12
    while position + 8 <= len(content):
        kind, length = struct.unpack_from("<4sI", content, position)
        found.append((kind, content[position + 8 : position + 8 + length]))
        position += 8 + length + length % 2
    return found
