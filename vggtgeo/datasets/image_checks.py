"""Check of an image file by Pillow, before a decoder takes memory for its pixels.

Decoders return pixels for files that end too early, and take memory for any size that a header declares. Pillow reads
the header, the EXIF orientation, and the check sums of a PNG. Damaged data of a JPEG are found by its decoder.
"""

from __future__ import annotations

import io
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile as PillowFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from PIL.WebPImagePlugin import WebPImageFile

from vggtgeo.io.errors import InputError

MAX_PIXELS = 100_000_000
"""Pixels of an image that is decoded: 0.3 GB."""
WHITE = 255
_WIDTH, _HEIGHT, _ORIENTATION = 256, 257, 274
_TIFF, _BIG_TIFF = (b"II*\0", b"MM\0*"), (b"II+\0", b"MM\0+")
# Of damaged EXIF data and directories: what is wrong with a file is the error below.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")
_BROKEN = (OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, EOFError, struct.error, OverflowError)
"""What Pillow raises for damaged files."""
# Not `PIL.Image.open`: it accepts any format, and has a limit of its own.
_READERS: dict[bytes, type[PillowFile]] = {
    b"\x89PNG": PngImageFile,
    b"\xff\xd8\xff": JpegImageFile,
    b"BM": BmpImageFile,
    b"RIFF": WebPImageFile,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"Pf"), PpmImageFile),
}


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image file.

    Fields: width, height, pixels. format, Pillow's name. orientation, EXIF, 1 to 8; 1 is as stored. white, the value of
    white of a binary PGM or PPM of 8 bits. scale, of a PFM.
    """

    width: int
    height: int
    format: str
    orientation: int = 1
    white: int = WHITE
    scale: float = 1.0


def image_header(content: bytes, path: Path) -> ImageHeader:
    """Return the header of an image file.

    Args:
        content: the file.
        path: its name, for messages.

    Raises:
        InputError: the file is empty, truncated, too large, or of a format that is not read.

    """
    if not content:
        raise InputError(f"`{path}` is empty")
    read = _tiff_header if content.startswith(_TIFF + _BIG_TIFF) else _header
    try:
        header = read(content)
    except Image.DecompressionBombError as error:  # Pillow's limit, of a WebP before its size is known here
        raise InputError(f"`{path}` has too many pixels: {error}") from None
    except _BROKEN as error:
        raise InputError(f"`{path}` is truncated or damaged: {error}") from None
    if header is None:
        raise InputError(
            f"`{path}` begins with {content[:16]!r}; it must be a PNG, JPEG, TIFF, WebP, BMP or PNM: convert it, or "
            "copy it again if it is damaged"
        )
    if header.width * header.height > MAX_PIXELS:
        size = f"{header.width} x {header.height} pixels"
        raise InputError(f"`{path}` declares {size}; at most {MAX_PIXELS // 10**6} million are decoded")
    return header


def _header(content: bytes) -> ImageHeader | None:
    """Return None for a format that is not read."""
    reader = next((reader for begin, reader in _READERS.items() if content.startswith(begin)), None)
    if reader is None:
        return None
    image = reader(io.BytesIO(content))
    try:
        orientation = _valid(Image.Image.getexif(image).get(_ORIENTATION))  # a PNG's own method decodes the image
    except _BROKEN:
        orientation = 1
    header = ImageHeader(
        *image.size, image.format or "", orientation, _white(image), float(image.info.get("scale", 1.0))
    )
    image.verify()  # the check sums of a PNG, up to its end
    return header


def _tiff_header(content: bytes) -> ImageHeader:
    """Return that of the first image; Pillow's class of TIFF lacks formats of pixels, such as doubles."""
    directory = ImageFileDirectory_v2(content[: 16 if content.startswith(_BIG_TIFF) else 8])
    file = io.BytesIO(content)
    file.seek(directory.next)
    directory.load(file)
    return ImageHeader(int(directory[_WIDTH]), int(directory[_HEIGHT]), "TIFF", _valid(directory.get(_ORIENTATION)))


def _valid(orientation: object) -> int:
    return orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1


def _white(image: PillowFile) -> int:
    """Pillow has a decoder for binary files with another white; files of text are scaled by OpenCV."""
    name, _, _, arguments = image.tile[0] if image.tile else ("", None, 0, None)
    return int(arguments[1]) if name == "ppm" and isinstance(arguments, tuple) and arguments[1] < WHITE else WHITE
