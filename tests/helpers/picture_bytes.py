"""Bytes of image files that OpenCV does not write: rare kinds of PNG, a CMYK JPEG, headers of other sizes."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np

GREY, RGB, PALETTE, GREY_ALPHA, RGB_ALPHA = 0, 2, 3, 4, 6
ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))


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


def interlaced_png(image: np.ndarray) -> bytes:
    """A PNG in seven passes."""
    rows = b"".join(plain(image[y::down, x::right]) for x, y, right, down in ADAM7)
    return png(image.shape[1::-1], 8, RGB, rows, interlaced=True)


def palette_png(size: tuple[int, int]) -> bytes:
    """A PNG of 256 colours, each with a transparency of its own."""
    width, height = size
    codes = np.arange(width * height).reshape(height, width).astype(np.uint8)
    table = chunk(b"PLTE", bytes(range(256)) * 3), chunk(b"tRNS", bytes(range(256)))
    return png(size, 8, PALETTE, plain(codes), more=table)


def two_colours_png(size: tuple[int, int]) -> bytes:
    """A PNG of one bit a pixel."""
    return png(size, 1, GREY, (b"\0" + b"\xaa" * (size[0] // 8)) * size[1])


def deep_png(image: np.ndarray) -> bytes:
    """A PNG of four channels of 16 bits."""
    wide = np.dstack([image, image[..., :1]]).astype(">u2") * 257
    return png(image.shape[1::-1], 16, RGB_ALPHA, plain(wide))


def cmyk_jpeg(size: tuple[int, int]) -> bytes:
    """A JPEG of four inks, mid grey in each: all coefficients are zero."""
    width, height = size
    segment = lambda mark, data: bytes([0xFF, mark]) + struct.pack(">H", len(data) + 2) + data
    table = lambda kind: segment(0xC4, bytes([kind, 1, *([0] * 15), 0]))  # one code of one bit, for zero
    frame = struct.pack(">BHHB", 8, height, width, 4) + b"".join(bytes([ink, 0x11, 0]) for ink in range(1, 5))
    scan = b"\x04" + b"".join(bytes([ink, 0]) for ink in range(1, 5)) + b"\0\x3f\0"
    blocks = 4 * (width // 8) * (height // 8)
    parts = (segment(0xDB, b"\0" + b"\x01" * 64), segment(0xC0, frame), table(0x00), table(0x10), segment(0xDA, scan))
    return b"\xff\xd8" + b"".join(parts) + b"\0" * (2 * blocks // 8) + b"\xff\xd9"


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


def tiff_header(width: int, height: int) -> bytes:
    """A TIFF that declares so many pixels and has hardly any."""
    tags = ((256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 2), (273, 4, 8), (277, 3, 3))
    tags = (*tags, (278, 4, height), (279, 4, 10))
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + b"\0" * 24


def big_tiff_header(width: int, height: int) -> bytes:
    """The same as a BigTIFF, whose offsets have eight bytes."""
    tags = ((256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 2), (273, 4, 16), (277, 3, 3))
    tags = (*tags, (278, 4, height), (279, 4, 10))
    entries = b"".join(struct.pack("<HHQQ", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II+\0" + struct.pack("<HHQQ", 8, 0, 16, len(tags)) + entries + b"\0" * 24


def webp_header(width: int, height: int) -> bytes:
    """A lossless WebP that declares so many pixels, at most 2^14 a side, and has none."""
    part = b"VP8L" + struct.pack("<IB", 30, 0x2F) + (width - 1 | height - 1 << 14).to_bytes(4, "little") + b"\0" * 25
    return b"RIFF" + struct.pack("<I", 4 + len(part)) + b"WEBP" + part


def bmp_header(width: int, height: int) -> bytes:
    """A BMP that declares so many pixels and has hardly any."""
    sizes = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 1000, 0, 0, 54) + sizes + b"\0" * 900


def npy(array: np.ndarray) -> bytes:
    """A file of NumPy."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def npy_header(shape: tuple[int, ...]) -> bytes:
    """One that declares so many floats, and holds none."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return stream.getvalue()
