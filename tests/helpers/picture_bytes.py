"""Bytes of image files that OpenCV does not write: rare kinds of PNG, a CMYK JPEG, headers of other sizes."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np

GREY, RGB, PALETTE, GREY_ALPHA, RGB_ALPHA = 0, 2, 3, 4, 6


def png(
    size: tuple[int, int], bits: int, kind: int, rows: bytes, interlaced: bool = False, more: tuple[bytes, ...] = ()
) -> bytes:
    """A PNG of these rows, each after the byte of its filter. more: chunks before the data."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, bits, kind, 0, 0, int(interlaced)))
    parts = (b"\x89PNG\r\n\x1a\n", header, *more, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    return b"".join(parts)


def chunk(name: bytes, data: bytes) -> bytes:
    """A part of a PNG."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def plain(image: np.ndarray) -> bytes:
    """The rows of an image without filters."""
    return b"".join(b"\0" + row.tobytes() for row in image)


def palette_png(size: tuple[int, int]) -> bytes:
    """A PNG of 256 colours, each with a transparency of its own."""
    width, height = size
    codes = np.arange(width * height).reshape(height, width).astype(np.uint8)
    table = chunk(b"PLTE", bytes(range(256)) * 3), chunk(b"tRNS", bytes(range(256)))
    return png(size, 8, PALETTE, plain(codes), more=table)


def deep_png(image: np.ndarray) -> bytes:
    """A PNG of four channels of 16 bits."""
    wide = np.dstack([image, image[..., :1]]).astype(">u2") * 257
    return png(image.shape[1::-1], 16, RGB_ALPHA, plain(wide))


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


def turned_tiff(whole: bytes) -> bytes:
    """A TIFF that asks to be turned: its directory again at its end, with one tag more."""
    (start,) = struct.unpack_from("<I", whole, 4)
    (count,) = struct.unpack_from("<H", whole, start)
    entries = [whole[start + 2 + 12 * row :][:12] for row in range(count)]
    turned = sorted([*entries, TURN[10:22]], key=lambda entry: struct.unpack_from("<H", entry))
    end = struct.pack("<H", count + 1) + b"".join(turned) + b"\0" * 4
    return whole[:4] + struct.pack("<I", len(whole)) + whole[8:] + end


def npy(array: np.ndarray) -> bytes:
    """A file of NumPy."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()
