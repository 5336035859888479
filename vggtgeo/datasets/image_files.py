"""Image files: checked by Pillow before a decoder takes memory for their pixels, decoded by simplejpeg and OpenCV; and
depth files: images of 16 bits, or floats in metres as TIFF, PFM, arrays of NumPy (`.npy`) or EXR.

Pillow reads the header, the EXIF orientation, and the check sums of a PNG. simplejpeg reports damaged data of a JPEG,
for which OpenCV returns grey or shifted pixels. Images are used as they are stored, whatever their EXIF orientation:
intrinsics and depth of a folder are those of the stored pixels.
"""

import io
import re
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import simplejpeg
from jaxtyping import Float, UInt8, UInt16
from PIL import Image, UnidentifiedImageError

from vggtgeo.io.archives import UNREADABLE
from vggtgeo.io.errors import InputError, install_hint
from vggtgeo.io.files import content_of

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})
OTHER_PICTURES = frozenset({".heic", ".heif", ".avif", ".jxl", ".jp2", ".gif", ".dng", ".raw", ".cr2", ".nef", ".arw"})
"""Image formats of phones and cameras that are not read."""
DEPTH_SUFFIXES = IMAGE_SUFFIXES | {".npy", ".pfm", ".exr"}
_EXR_DEPTH = re.compile(r"(.*[.])?(z|depth|depth[.]v|y|v|r)", re.IGNORECASE)
"""Names of the depth channel in files of Blender, Nuke and Record3D, and in grey images."""
MAX_PIXELS = 100_000_000
"""Maximum number of pixels of an image that is decoded: 0.3 GB."""
MAX_BYTES = 700_000_000
"""Maximum size of an image file: 100 million pixels of 16 bits in three channels, uncompressed, and its header."""
BITS = (8, 10, 12, 14, 16)
"""Possible bits of the values in a 16-bit file: cameras of 10 and 12 bits do not use its full range."""
_FORMATS = ("PNG", "JPEG", "BMP", "WEBP", "PPM", "TIFF")
_ORIENTATION = 274
_BROKEN = (
    *(OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, EOFError, struct.error, OverflowError),
    Image.DecompressionBombError,
)
"""Exceptions that Pillow raises for damaged files."""
# Pillow warns of damaged EXIF data and directories, which do no harm; what does harm is an error of this module.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")
_FEW_EXTRA_BYTES = re.compile(r"data: [1-4] extraneous bytes before marker 0xd9")
"""Encoders of some cameras write a few bytes between the data and the end mark of a JPEG."""


@dataclass(frozen=True, eq=False)
class ImageFile:
    """Image and properties of its file.

    Fields: image, uint8 [H, W, 3] RGB, as stored. bits, of its values, one of `BITS`. orientation, EXIF, 1 for none.
    """

    image: UInt8[np.ndarray, "h w 3"]
    bits: int
    orientation: int


class ImageHeader(NamedTuple):
    """Header of an image file. Fields: format, Pillow's name; orientation, EXIF, 1 to 8."""

    format: str
    orientation: int


def read_image_file(path: Path, min_bits: int = 8) -> ImageFile:
    """Return the image, as RGB, and the properties of its file.

    Raises InputError if the file is missing, damaged or not an image.
    min_bits: minimum number of bits to assume for a 16-bit image. The bits of previous images are given here, so that a
    dark image is not brightened.
    """
    return image_in(content_of(path, MAX_BYTES), path, min_bits)


def image_in(content: bytes, path: Path, min_bits: int = 8) -> ImageFile:
    """Return the image in the content of a file; path: its name, for errors. Otherwise as `read_image_file`."""
    header = image_header(content, path)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = decoded(content, path, flags, header)
    if image.dtype not in (np.uint8, np.uint16) or image.ndim != 3:
        raise InputError(f"`{path}` must have 8 or 16 bits, got {image.dtype} of shape {image.shape}")
    image, bits = eight_bits(image, min_bits)
    return ImageFile(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), bits, header.orientation)


def eight_bits(image: np.ndarray, min_bits: int = 8) -> tuple[np.ndarray, int]:
    """Return an image of 8 or 16 bits as uint8, and the bits of its values, one of `BITS`; see `read_image_file`."""
    if image.dtype == np.uint8:
        return image, BITS[0]
    needed = max(int(image.max(initial=0)).bit_length(), min_bits)
    bits = next(known for known in BITS if known >= needed)
    return (image >> (bits - 8)).astype(np.uint8), bits


def image_header(content: bytes, path: Path) -> ImageHeader:
    """Return the header of an image file; path: its name, for errors.

    Raises InputError if the file is empty, truncated, too large, or of an unsupported format.
    """
    try:
        with Image.open(io.BytesIO(content), formats=_FORMATS) as image:
            # `getexif` of Pillow's PNG class would decode the whole image; that of its base class does not.
            tagged = image.format in ("JPEG", "MPO", "PNG", "WEBP")
            orientation = Image.Image.getexif(image).get(_ORIENTATION, 1) if tagged else 1
            header = ImageHeader(image.format or "", orientation if orientation in range(1, 9) else 1)
            _check_pixel_count(path, image.width * image.height)
            image.verify()  # the check sums of a PNG, up to its end
    except InputError:
        raise
    except UnidentifiedImageError:
        raise InputError(
            f"`{path}` must be a PNG, JPEG, TIFF, WebP, BMP or PNM, got a file that begins with {content[:16]!r}: "
            "convert it, or copy it again if it is damaged"
        ) from None
    except _BROKEN as error:
        raise InputError(f"`{path}` is truncated or damaged: {error}") from None
    return header


def _check_pixel_count(path: Path, count: int) -> None:
    if not 0 < count <= MAX_PIXELS:
        raise InputError(f"`{path}` declares {count} pixels; at most {MAX_PIXELS // 10**6} million are decoded")


def path_exists(path: Path) -> bool:
    """Return whether a path exists; False for names that the file system does not accept."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def decoded(content: bytes, path: Path, flags: int, header: ImageHeader | None = None) -> np.ndarray:
    """Return the pixels in the content of an image file, as OpenCV has them (BGR); raise InputError if it is invalid.

    path: its name, for errors. flags: of `cv2.imdecode`; without effect on a JPEG. header: if already known.
    """
    if (header or image_header(content, path)).format in ("JPEG", "MPO"):
        try:
            return simplejpeg.decode_jpeg(content, "BGR")
        except ValueError as error:
            damaged = str(error).startswith(("Corrupt JPEG data", "Premature end"))
            if damaged and not _FEW_EXTRA_BYTES.search(str(error)):
                raise InputError(f"`{path}` is truncated or damaged: {error}") from None
    try:  # also for JPEGs of rare subsamplings and of arithmetic coding, which simplejpeg does not decode
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"`{path}` cannot be decoded: {error.err}") from None
    if image is None:
        raise InputError(f"`{path}` cannot be decoded: it is damaged, or OpenCV does not support it")
    return image


@dataclass(frozen=True)
class DepthFormat:
    """Unit of depth files.

    Fields: units_per_metre, of 16-bit values. invalid, 16-bit values that mean "no depth". floats_per_metre, units per
    metre of floating-point values, 1 by convention.
    """

    units_per_metre: float
    invalid: tuple[int, ...] = (0,)
    floats_per_metre: float = 1.0


MIN_DEPTH, MAX_DEPTH = 1e-3, 1000.0
"""Valid range, metres. Renderers write 1e10 for the background; floats of the wrong byte order read as 1e-40."""
MILLIMETRES = DepthFormat(1000.0, (0, 65535))
"""7-Scenes: 0 and 65535 mean no depth."""
FIVE_THOUSANDTHS = DepthFormat(5000.0)
"""TUM RGB-D: 5000 is one metre."""


def read_depth(path: Path, coding: DepthFormat) -> Float[np.ndarray, "h w"]:
    """Return depth, float32 metres, NaN for none, of an image, a PFM, an EXR or an array of NumPy (`.npy`); raise
    InputError if the file cannot be read, or is not one channel of uint16 or floats.
    """
    codes = read_codes(path)
    codes = codes[..., 0] if codes.ndim == 3 and codes.shape[2] == 1 else codes
    if codes.ndim == 2 and np.issubdtype(codes.dtype, np.floating):
        return metres_of_floats(codes, coding.floats_per_metre)
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise InputError(
            f"`{path}` must have one channel of uint16 or float depth, got {codes.dtype} of shape {codes.shape}"
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


def read_codes(path: Path) -> np.ndarray:
    """Return the values of an image or an array of NumPy as they are stored; raise InputError if it cannot be read."""
    if path.suffix.lower() == ".exr":
        return exr_depth(path)
    content = content_of(path, MAX_BYTES)
    if path.suffix.lower() != ".npy":
        return decoded(content, path, cv2.IMREAD_UNCHANGED)
    try:
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))  # a pickle could run code
    except UNREADABLE as error:
        raise InputError(f"`{path}` is not an array of NumPy that can be read: {error}") from None


def exr_depth(path: Path) -> np.ndarray:
    """Return the one channel that may be depth, float [H, W], as stored; read by OpenEXR (extra `phones`)."""
    try:
        import OpenEXR
    except ImportError:
        raise InputError(f"`{path}` needs the package OpenEXR; {install_hint('phones')}") from None
    content_of(path, MAX_BYTES)  # raises if it cannot be read: OpenEXR's own errors give no reason
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        (left, top), (right, bottom) = header["dataWindow"]
        names = [channel.name for channel in header["channels"]]
        # OpenEXR decodes all channels, so all of them count.
        _check_pixel_count(path, (int(right) - int(left) + 1) * (int(bottom) - int(top) + 1) * len(names))
        found = [name for name in names if _EXR_DEPTH.fullmatch(name)]
        if len(found) > 1:  # Blender writes colours, too: R, G, B beside Z
            found = [name for name in found if name.lower().endswith(("z", "depth", "depth.v"))] or found
        if len(found) != 1:
            raise InputError(f"`{path}` must have one channel Z, V, Y, R or depth, got {', '.join(names)}")
        return np.asarray(OpenEXR.File(str(path), separate_channels=True).channels()[found[0]].pixels)
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise InputError(f"`{path}` cannot be decoded: {error}") from None
