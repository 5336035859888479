"""Image and depth files, decoded by OpenCV, with the checks that OpenCV leaves out.

OpenCV hands back a picture for a JPEG whose data end too early or are damaged, partly grey or shifted, and turns an
image as its EXIF data say, which neither the intrinsics nor the depth of a folder know of. So JPEGs are decoded by
simplejpeg, which says what libjpeg-turbo warns of, files are looked at before (`image_defects.py`), and images are used
as they are stored.
"""

import io
import math
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from jaxtyping import Float, UInt8, UInt16

from vggtgeo.datasets.exr_files import exr_depth
from vggtgeo.datasets.image_defects import decoding_defect, defect
from vggtgeo.datasets.image_orientation import as_stored, orientation
from vggtgeo.datasets.image_sizes import declared_white
from vggtgeo.io.archives import UNREADABLE, array_header
from vggtgeo.io.errors import InputError

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})

OTHER_PICTURES = frozenset(
    {
        *(".heic", ".heif", ".avif", ".jxl", ".jp2", ".j2k", ".gif", ".tga", ".dng", ".raw", ".cr2", ".cr3", ".nef"),
        *(".arw", ".raf", ".orf", ".rw2"),
    }
)
"""Of phones and cameras, and what image programs write."""

UNFINISHED = frozenset({".icloud", ".part", ".partial", ".filepart", ".crdownload", ".download", ".tmp"})
"""Behind the name of a file that is still elsewhere, or is still being copied."""

DEPTH_SUFFIXES = IMAGE_SUFFIXES | {".npy", ".pfm", ".exr"}


@dataclass(frozen=True)
class DepthFormat:
    """How a depth file codes metres: `units_per_metre` of 16-bit numbers, and which of them mean "no depth"; floats are
    metres by convention, `floats_per_metre` of them.
    """

    units_per_metre: float
    invalid: tuple[int, ...] = (0,)
    floats_per_metre: float = 1.0


NEAREST, FARTHEST = 1e-3, 1000.0
"""Metres, of a float: renderers write 1e10 where there is nothing, and bytes in the wrong order are 1e-40."""

MILLIMETRES = DepthFormat(1000.0, (0, 65535))
"""7-Scenes: 0 and, as published, 65535 mean none."""

FIVE_THOUSANDTHS = DepthFormat(5000.0)
"""TUM RGB-D: 5000 is one metre."""


WHITE = 255
BITS = (8, 10, 12, 14, 16)
"""Bits that the values of a 16-bit file may have: cameras of 10 and 12 bits write such files, and never fill them."""


@dataclass(frozen=True, eq=False)
class ImageFile:
    """image: uint8 [H, W, 3] RGB, as it is stored, whatever the file says about turning it. bits: that its values need,
    one of `BITS`. orientation: what the file says about turning it, 1 for nothing.
    """

    image: UInt8[np.ndarray, "h w 3"]
    bits: int
    orientation: int


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """The image as RGB; InputError with the reason where the file is missing, cut off, or not an image."""
    return read_image_file(path).image


def read_image_file(path: Path, least_bits: int = 8) -> ImageFile:
    """The image as RGB, and what must be known of its file; InputError as `read_image` has it.

    least_bits: that a 16-bit image has at least, however dark it is: those of the images before it.
    """
    return image_in(file_content(path), path, least_bits)


def image_in(content: bytes, path: Path, least_bits: int = 8) -> ImageFile:
    """The image whose file has these bytes. path: for messages; otherwise as `read_image_file`."""
    image = decoded(content, path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype not in (np.uint8, np.uint16) or image.ndim != 3:
        raise InputError(f"`{path}`: found {image.dtype} of shape {image.shape}; images must have 8 or 16 bits")
    image, bits = eight_bits(image, least_bits)
    if bits == BITS[0] and 0 < (white := declared_white(content)) < WHITE:  # OpenCV scales those of text files alone
        image = cv2.convertScaleAbs(image, alpha=WHITE / white)
    return ImageFile(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), bits, orientation(content))


def eight_bits(image: np.ndarray, least_bits: int = 8) -> tuple[np.ndarray, int]:
    """An image of 8 or 16 bits as uint8, and how many bits its values need, one of `BITS`; see `read_image_file`."""
    if image.dtype == np.uint8:
        return image, BITS[0]
    needed = max(int(image.max(initial=0)).bit_length(), least_bits)
    bits = next(known for known in BITS if known >= needed)
    return (image >> (bits - 8)).astype(np.uint8), bits


def read_depth(path: Path, coding: DepthFormat) -> Float[np.ndarray, "h w"]:
    """The depth, float32 metres, NaN for none, of an image or an array of NumPy (`.npy`); InputError where it has not
    one channel, of 16-bit numbers or of floats.
    """
    codes = read_codes(path)
    codes = codes[..., 0] if codes.ndim == 3 and codes.shape[2] == 1 else codes
    if codes.ndim == 2 and np.issubdtype(codes.dtype, np.floating):
        return metres_of_floats(codes, coding.floats_per_metre)
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise InputError(
            f"`{path}`: found {codes.dtype} of shape {codes.shape}; depth must have one channel, of uint16 or of "
            "floats in metres"
        )
    return metres_of_codes(codes, coding)


def metres_of_codes(codes: UInt16[np.ndarray, "h w"], coding: DepthFormat) -> Float[np.ndarray, "h w"]:
    """Depth that is stored in 16 bits, float32 metres, NaN for none."""
    depth = np.divide(codes, np.float32(coding.units_per_metre), dtype=np.float32)
    for code in coding.invalid:
        depth[codes == code] = np.nan
    return depth


def metres_of_floats(codes: np.ndarray, per_metre: float = 1.0) -> Float[np.ndarray, "h w"]:
    """Depth that is stored as floats, float32 metres, NaN for what no camera of a room sees."""
    with np.errstate(over="ignore", invalid="ignore"):
        depth = np.divide(codes, per_metre).astype(np.float32)
        return np.where((depth >= NEAREST) & (depth <= FARTHEST), depth, np.float32(np.nan))


def floats_out_of_range(path: Path) -> str:
    """What to say of a file of floats that has depth and none that is one, of millimetres, say; nothing of another."""
    codes = read_codes(path)
    there = codes[np.isfinite(codes) & (codes > 0)] if np.issubdtype(codes.dtype, np.floating) else codes[:0]
    if not there.size:
        return ""
    return (
        f" (`{path}`: its depth goes from {there.min():g} to {there.max():g}, and none of it is from {NEAREST:g} to "
        f"{FARTHEST:g} m: `--depth-scale` says how many there are in a metre: 1000 are millimetres)"
    )


def read_codes(path: Path) -> np.ndarray:
    """The numbers in an image or an array of NumPy, as they are stored; InputError where it cannot be read."""
    if path.suffix.lower() == ".npy":
        return _array(path)
    if path.suffix.lower() == ".exr":
        return exr_depth(path)
    content = file_content(path)
    if content.startswith(b"Pf"):
        _check_pfm(content, path)
    return decoded(content, path, cv2.IMREAD_UNCHANGED)


def _check_pfm(content: bytes, path: Path) -> None:
    """InputError for a PFM whose header is none, or states another scale than 1: OpenCV divides by it, other programs
    multiply with it, or leave it alone.
    """
    head = re.match(rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+(\S{1,40})\s", content)
    try:
        scale = abs(float(head[3])) if head else math.nan
    except ValueError:
        scale = math.nan
    if head is None or not 0 < scale < math.inf:
        raise InputError(f"`{path}` has no header of a PFM: `Pf`, width and height, -1.0 or 1.0")
    width, height = int(head[1]), int(head[2])
    if len(content) - head.end() < 4 * width * height:
        raise InputError(f"`{path}` is cut off: it declares {width} x {height} pixels and has {len(content)} bytes")
    if scale != 1:
        raise InputError(
            f"`{path}` states a scale of {scale:g}, which programs read in different ways: write it with -1.0 (or 1.0 "
            "where the highest byte is the first), in metres"
        )


def _array(path: Path) -> np.ndarray:
    """What an `.npy` file holds; no pickle is opened, and no size that its header declares is believed."""
    content = file_content(path)
    try:
        stream = io.BytesIO(content)
        header = array_header(stream)
        if header.dtype.hasobject:
            raise ValueError("it holds Python objects")
        if header.bytes != len(content) - stream.tell():
            raise ValueError(f"it declares {header.bytes} bytes and has {len(content) - stream.tell()}")
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))
    except UNREADABLE as error:
        raise InputError(f"`{path}` is no array of NumPy that can be read: {error}") from None


MOST_BYTES = 700_000_000
"""Of an image's file: all that is decoded, a hundred million pixels, unpacked, of 16 bits in three channels."""


def is_there(path: Path) -> bool:
    """Whether there is such a path; a list may name what no file system takes, or what may not be looked at."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def file_content(path: Path, most: int = MOST_BYTES) -> bytes:
    """All bytes of a regular file that is no larger than an image can be, or than `most`."""
    try:
        if path.exists() and not path.is_file():  # a list may name a pipe, which has no end
            raise InputError(f"`{path}` is no regular file")
        size = path.stat().st_size
        if size > most:
            raise InputError(f"`{path}` has {size} bytes, more than {most}: not decoded")
        return path.read_bytes()
    except (OSError, ValueError) as error:  # a name from a list may be none that a file system takes
        raise InputError(f"`{path}` cannot be read: {getattr(error, 'strerror', None) or error}") from None


def decoded(content: bytes, path: Path, flags: int) -> np.ndarray:
    """The image in the bytes of a file, as OpenCV has it. path: for messages; InputError with what is wrong."""
    wrong = defect(content)
    if wrong:
        raise InputError(f"`{path}` {wrong}")
    if content.startswith(b"\xff\xd8"):
        try:
            return simplejpeg.decode_jpeg(content, "BGR")
        except ValueError as error:
            wrong = decoding_defect(str(error))
        if wrong:
            raise InputError(f"`{path}` {wrong}")
    try:  # JPEGs too that simplejpeg does not know: of rare samplings, of arithmetic coding
        image = cv2.imdecode(np.frombuffer(as_stored(content), np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"`{path}` cannot be decoded: {error.err}") from None
    if image is None:
        raise InputError(f"`{path}` cannot be decoded: it is damaged, or not an image")
    return image
