"""Tags of the first directory of a TIFF (TIFF 6.0), a BigTIFF, or EXIF data, which are a TIFF without a picture."""

from __future__ import annotations

import struct
from dataclasses import dataclass

STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_MOST_TAGS = 4096
_FORMATS = {1: "B", 3: "H", 4: "I", 16: "Q"}


@dataclass(frozen=True)
class Tag:
    """The first number of a tag. Fields: value; place, of its bytes in the file; format, theirs as `struct` has it."""

    value: int
    place: int
    format: str


def tiff_tags(content: bytes) -> dict[int, Tag]:
    """Whole numbers by their tag; none where `content` is no TIFF, those before where a directory ends too early."""
    if not content.startswith(STARTS):
        return {}
    order = "<" if content.startswith(b"II") else ">"
    big = content[2:4] in (b"+\0", b"\0+")
    first, count_of, width = (f"{order}Q", f"{order}Q", 20) if big else (f"{order}I", f"{order}H", 12)
    found: dict[int, Tag] = {}
    try:
        (start,) = struct.unpack_from(first, content, 8 if big else 4)
        (count,) = struct.unpack_from(count_of, content, start)
        start += struct.calcsize(count_of)
        for entry in range(start, start + width * min(count, _MOST_TAGS), width):
            tag, kind = struct.unpack_from(f"{order}HH", content, entry)
            form = f"{order}{_FORMATS.get(kind, 'I')}"
            place = entry + width - (8 if big else 4)
            found.setdefault(tag, Tag(struct.unpack_from(form, content, place)[0], place, form))  # as libtiff
    except (struct.error, OverflowError):  # an offset may be beyond all places
        pass
    return found
