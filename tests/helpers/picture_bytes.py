"""Bytes of image files that OpenCV does not write: rare kinds of PNG, a CMYK JPEG, headers of other sizes."""

from __future__ import annotations

import struct
import zlib

GREY, RGB, PALETTE, GREY_ALPHA, RGB_ALPHA = 0, 2, 3, 4, 6


def chunk(name: bytes, data: bytes) -> bytes:
    """A part of a PNG."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


TURN = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
"""EXIF data that ask for a turn by 90 degrees."""


def turned_png(whole: bytes) -> bytes:
    """A PNG that asks to be turned."""
    return whole[:33] + chunk(b"eXIf", TURN) + whole[33:]


def turned_webp(whole: bytes, size: tuple[int, int]) -> bytes:
    """A WebP that asks to be turned: its picture in the extended form, with EXIF data."""
    sides = b"".join((side - 1).to_bytes(3, "little") for side in size)
    part = lambda name, data: name + struct.pack("<I", len(data)) + data
    inside = b"WEBP" + part(b"VP8X", b"\x08\0\0\0" + sides) + whole[12:] + part(b"EXIF", TURN)
    return part(b"RIFF", inside)
