"""Image and depth files, decoded by OpenCV, with the checks that OpenCV leaves out.

OpenCV may hand back a partly grey image for a JPEG that ends too early; so a file must have its format's end
mark before it is decoded.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from vggtgeo.io.errors import InputError

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})


@dataclass(frozen=True)
class DepthFormat:
    """How a depth file codes metres: 16-bit, `units_per_metre`, and the codes that mean "no depth"."""

    units_per_metre: float
    invalid: tuple[int, ...] = (0,)


MILLIMETRES = DepthFormat(1000.0, (0, 65535))
"""7-Scenes: 0 and, as published, 65535 mean none."""

FIVE_THOUSANDTHS = DepthFormat(5000.0)
"""TUM RGB-D: 5000 is one metre."""


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """The image as RGB; InputError with the reason where the file is missing, cut off, or not an image."""
    image = _decode(path, cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def read_depth(path: Path, coding: DepthFormat) -> Float[np.ndarray, "h w"]:
    """The depth, float32 metres, NaN for none; InputError where the file is no 16-bit one-channel image."""
    codes = _decode(path, cv2.IMREAD_UNCHANGED)
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise InputError(f"`{path}`: found {codes.dtype} of shape {codes.shape}; depth must be uint16 with one channel")
    depth = np.divide(codes, np.float32(coding.units_per_metre), dtype=np.float32)
    for code in coding.invalid:
        depth[codes == code] = np.nan
    return depth


def _decode(path: Path, flags: int) -> np.ndarray:
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"`{path}` cannot be read: {error.strerror or error}") from None
    defect = _defect(content.tobytes())
    if defect:
        raise InputError(f"`{path}` {defect}")
    image = cv2.imdecode(content, flags)
    if image is None:
        raise InputError(f"`{path}` cannot be decoded: it is damaged, or not an image")
    return image


def _defect(content: bytes) -> str:
    if not content:
        return "is empty"
    if content.startswith(b"\x89PNG") and content.rfind(b"IEND") < 0:
        return "is cut off: the PNG has no end"
    if content.startswith(b"\xff\xd8") and content.rfind(b"\xff\xd9") < _start_of_scan(content):
        return "is cut off: the JPEG has no end"
    return ""


def _start_of_scan(content: bytes) -> int:
    """Where a JPEG's image data begin; its length where there are none. Thumbnails before it have ends of their own."""
    position = 2
    while position + 4 <= len(content) and content[position] == 0xFF:
        if content[position + 1] == 0xDA:
            return position
        position += 2 + int.from_bytes(content[position + 2 : position + 4])
    return len(content)
