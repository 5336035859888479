"""Image and depth files: checked by Pillow (`image_checks.py`), decoded by simplejpeg and OpenCV.

simplejpeg reports damaged data of a JPEG, for which OpenCV returns grey or shifted pixels. Images are used as they are
stored, whatever their EXIF orientation: intrinsics and depth of a folder are those of the stored pixels.
"""

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from jaxtyping import Float, UInt8, UInt16

from vggtgeo.datasets.exr_files import exr_depth
from vggtgeo.datasets.image_checks import WHITE, ImageHeader, image_header
from vggtgeo.io.archives import UNREADABLE, array_header
from vggtgeo.io.errors import InputError

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})

OTHER_PICTURES = frozenset(
    {
        *(".heic", ".heif", ".avif", ".jxl", ".jp2", ".j2k", ".gif", ".tga", ".dng", ".raw", ".cr2", ".cr3", ".nef"),
        *(".arw", ".raf", ".orf", ".rw2"),
    }
)
"""Image formats of phones, cameras and image programs that are not read."""

UNFINISHED = frozenset({".icloud", ".part", ".partial", ".filepart", ".crdownload", ".download", ".tmp"})
"""Suffixes of files that are not downloaded, or still being copied."""

DEPTH_SUFFIXES = IMAGE_SUFFIXES | {".npy", ".pfm", ".exr"}


@dataclass(frozen=True)
class DepthFormat:
    """Unit of depth files.

    Fields: units_per_metre, of 16-bit values. invalid, 16-bit values that mean "no depth". floats_per_metre, units of
    floating-point values, which are metres by convention.
    """

    units_per_metre: float
    invalid: tuple[int, ...] = (0,)
    floats_per_metre: float = 1.0


MIN_DEPTH, MAX_DEPTH = 1e-3, 1000.0
"""Metres, of floating-point depth: renderers write 1e10 for the background, and swapped bytes read as 1e-40."""

MILLIMETRES = DepthFormat(1000.0, (0, 65535))
"""7-Scenes: 0 and 65535 mean no depth."""

FIVE_THOUSANDTHS = DepthFormat(5000.0)
"""TUM RGB-D: 5000 is one metre."""

BITS = (8, 10, 12, 14, 16)
"""Bits of the values in a 16-bit file: cameras of 10 and 12 bits write such files without filling them."""
_FEW_EXTRA_BYTES = re.compile(r"data: [1-4] extraneous bytes before marker 0xd9")
"""Encoders of some cameras write a few bytes between the data and the end mark of a JPEG."""
_SHOWN_TO_STORED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.swapaxes(0, 1),
    6: np.rot90,
    7: lambda image: image[::-1, ::-1].swapaxes(0, 1),
    8: lambda image: np.rot90(image, -1),
}
"""Inverse of each EXIF orientation: OpenCV applies that of a TIFF whatever its flags."""


@dataclass(frozen=True, eq=False)
class ImageFile:
    """Image and properties of its file.

    Fields: image, uint8 [H, W, 3] RGB, as stored. bits, of its values, one of `BITS`. orientation, EXIF, 1 for none.
    """

    image: UInt8[np.ndarray, "h w 3"]
    bits: int
    orientation: int


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image as RGB; raise InputError if the file is missing, damaged or not an image."""
    return read_image_file(path).image


def read_image_file(path: Path, min_bits: int = 8) -> ImageFile:
    """Return the image and the properties of its file; errors as `read_image`.

    min_bits: the least number of bits of a 16-bit image, however dark it is: that of the images before it.
    """
    return image_in(file_content(path), path, min_bits)


def image_in(content: bytes, path: Path, min_bits: int = 8) -> ImageFile:
    """Return the image in the content of a file; path: for messages. Otherwise as `read_image_file`."""
    header = image_header(content, path)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = _pixels(content, header, path, flags)
    if image.dtype not in (np.uint8, np.uint16) or image.ndim != 3:
        raise InputError(f"`{path}` is {image.dtype} of shape {image.shape}; images must have 8 or 16 bits")
    image, bits = eight_bits(image, min_bits)
    if bits == BITS[0] and header.white < WHITE:
        image = cv2.convertScaleAbs(image, alpha=WHITE / header.white)
    return ImageFile(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), bits, header.orientation)


def eight_bits(image: np.ndarray, min_bits: int = 8) -> tuple[np.ndarray, int]:
    """Return an image of 8 or 16 bits as uint8, and the bits of its values, one of `BITS`; see `read_image_file`."""
    if image.dtype == np.uint8:
        return image, BITS[0]
    needed = max(int(image.max(initial=0)).bit_length(), min_bits)
    bits = next(known for known in BITS if known >= needed)
    return (image >> (bits - 8)).astype(np.uint8), bits


def orientation_message(path: Path, orientation: int) -> str:
    """Return the text of the warning about an EXIF orientation."""
    return (
        f"`{path}` has the EXIF orientation {orientation}, which is not applied: intrinsics and depth must be those of "
        "the stored images"
    )


def read_depth(path: Path, coding: DepthFormat) -> Float[np.ndarray, "h w"]:
    """Return depth, float32 metres, NaN for none, of an image, a PFM, an EXR or an array of NumPy (`.npy`).

    Raises:
        InputError: the file cannot be read, or is not one channel of uint16 or floats.

    """
    codes = read_codes(path)
    codes = codes[..., 0] if codes.ndim == 3 and codes.shape[2] == 1 else codes
    if codes.ndim == 2 and np.issubdtype(codes.dtype, np.floating):
        return metres_of_floats(codes, coding.floats_per_metre)
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise InputError(
            f"`{path}` is {codes.dtype} of shape {codes.shape}; depth must have one channel, of uint16 or of floats in "
            "metres"
        )
    return metres_of_codes(codes, coding)


def metres_of_codes(codes: UInt16[np.ndarray, "h w"], coding: DepthFormat) -> Float[np.ndarray, "h w"]:
    """Return depth of 16-bit values, float32 metres, NaN for none."""
    depth = np.divide(codes, np.float32(coding.units_per_metre), dtype=np.float32)
    for code in coding.invalid:
        depth[codes == code] = np.nan
    return depth


def metres_of_floats(codes: np.ndarray, per_metre: float = 1.0) -> Float[np.ndarray, "h w"]:
    """Return depth of floating-point values, float32 metres, NaN outside `MIN_DEPTH` to `MAX_DEPTH`."""
    with np.errstate(over="ignore", invalid="ignore"):
        depth = np.divide(codes, per_metre).astype(np.float32)
        return np.where((depth >= MIN_DEPTH) & (depth <= MAX_DEPTH), depth, np.float32(np.nan))


def floats_out_of_range(path: Path) -> str:
    """Return a hint about the unit if a file of floats has depth and no value of it is in range; "" otherwise."""
    codes = read_codes(path)
    known = codes[np.isfinite(codes) & (codes > 0)] if np.issubdtype(codes.dtype, np.floating) else codes[:0]
    if not known.size:
        return ""
    return (
        f" (`{path}`: its depth is {known.min():g} to {known.max():g}; it must be {MIN_DEPTH:g} to {MAX_DEPTH:g} m: "
        "give the values in a metre by `--depth-scale`, 1000 for millimetres)"
    )


def read_codes(path: Path) -> np.ndarray:
    """Return the values of an image or an array of NumPy as they are stored; raise InputError if it cannot be read."""
    if path.suffix.lower() == ".npy":
        return _array(path)
    if path.suffix.lower() == ".exr":
        return exr_depth(path)
    return decoded(file_content(path), path, cv2.IMREAD_UNCHANGED)


def _array(path: Path) -> np.ndarray:
    """Return the array of an `.npy` file; pickles are not opened, and the declared size is checked first."""
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
        raise InputError(f"`{path}` is not an array of NumPy that can be read: {error}") from None


MAX_BYTES = 700_000_000
"""Size of an image file: 100 million pixels of 16 bits in three channels, uncompressed, and some."""


def is_there(path: Path) -> bool:
    """Return whether a path exists; False for names that the file system does not accept."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def file_content(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Return the content of a regular file; raise InputError if it is larger, or cannot be read."""
    try:
        if path.exists() and not path.is_file():  # a pipe has no end
            raise InputError(f"`{path}` is not a regular file")
        size = path.stat().st_size
        if size > max_bytes:
            raise InputError(f"`{path}` has {size} bytes; at most {max_bytes} are read")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"`{path}` cannot be read: {getattr(error, 'strerror', None) or error}") from None


def decoded(content: bytes, path: Path, flags: int) -> np.ndarray:
    """Return the pixels in the content of an image file, as OpenCV has them (BGR).

    Args:
        content: the file.
        path: its name, for messages.
        flags: of `cv2.imdecode`; without effect on a JPEG.

    Raises:
        InputError: the file is damaged, too large, or not an image.

    """
    return _pixels(content, image_header(content, path), path, flags)


def _pixels(content: bytes, header: ImageHeader, path: Path, flags: int) -> np.ndarray:
    if header.scale != 1:
        raise InputError(
            f"`{path}` states a scale of {header.scale:g}, which programs read in different ways; it must be -1.0 or "
            "1.0, with depth in metres"
        )
    if header.format in ("JPEG", "MPO"):
        try:
            return simplejpeg.decode_jpeg(content, "BGR")
        except ValueError as error:
            damaged = str(error).startswith(("Corrupt JPEG data", "Premature end"))
            if damaged and not _FEW_EXTRA_BYTES.search(str(error)):
                raise InputError(f"`{path}` is truncated or damaged: {error}") from None
    try:  # JPEGs of rare samplings and of arithmetic coding, too, which simplejpeg does not decode
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"`{path}` cannot be decoded: {error.err}") from None
    if image is None:
        raise InputError(f"`{path}` cannot be decoded: it is damaged, or of a kind that OpenCV does not decode")
    stored = _SHOWN_TO_STORED[header.orientation](image) if header.format == "TIFF" else image
    return np.ascontiguousarray(stored)
