"""Width and height that the header of an image file declares, read before a decoder takes memory for them."""

from __future__ import annotations

import re
import struct

from vggtgeo.datasets.tiff_tags import STARTS, tiff_tags

_GAP = rb"\s+(?:#[^\n]*\n\s*)*"
_PNM = re.compile(rb"P[1-6]" + _GAP + rb"(\d{1,12})" + _GAP + rb"(\d{1,12})\s")
_PNM_WHITE = re.compile(rb"P[56]" + _GAP + rb"\d{1,12}" + _GAP + rb"\d{1,12}" + _GAP + rb"(\d{1,5})\s")
_WIDTH, _HEIGHT = 256, 257


def size_of_tiff(content: bytes) -> tuple[int, int]:
    """Of the first image of a TIFF or BigTIFF."""
    found = tiff_tags(content)
    return (found[_WIDTH].value, found[_HEIGHT].value) if _WIDTH in found and _HEIGHT in found else (0, 0)


def size_of_webp(content: bytes) -> tuple[int, int]:
    """Of a lossy, a lossless, or an extended WebP (https://developers.google.com/speed/webp/docs/riff_container)."""
    kind = content[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(content[24:27], "little"), 1 + int.from_bytes(content[27:30], "little")
    if kind == b"VP8L":
        bits = int.from_bytes(content[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", content, 26)
    return width & 0x3FFF, height & 0x3FFF


def size_of_bmp(content: bytes) -> tuple[int, int]:
    """Of a BMP, whose height may be negative: rows from the top."""
    width, height = struct.unpack_from("<ii", content, 18)
    return abs(width), abs(height)


def declared_size(content: bytes) -> tuple[int, int]:
    """Of a TIFF, WebP, BMP, PBM, PGM or PPM; (0, 0) for any other file, and where the header ends too early."""
    try:
        if content.startswith(STARTS):
            return size_of_tiff(content)
        if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
            return size_of_webp(content)
        if content[:2] == b"BM":
            return size_of_bmp(content)
    except struct.error:
        return 0, 0
    plain = _PNM.match(content)
    return (int(plain[1]), int(plain[2])) if plain else (0, 0)


def declared_white(content: bytes) -> int:
    """The value that means white in a binary PGM or PPM, 1 to 65535; 0 in any other file."""
    white = _PNM_WHITE.match(content)
    return int(white[1]) if white else 0
