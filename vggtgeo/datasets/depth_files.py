"""Depth files: images of 16 bits, or floats in metres as TIFF, PFM, arrays of NumPy (`.npy`) or EXR."""

import io
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt16

from vggtgeo.datasets.image_files import IMAGE_SUFFIXES, MAX_BYTES, MAX_PIXELS, decoded
from vggtgeo.io.archives import UNREADABLE, array_header
from vggtgeo.io.errors import InputError, install_hint
from vggtgeo.io.text_files import content_of

DEPTH_SUFFIXES = IMAGE_SUFFIXES | {".npy", ".pfm", ".exr"}
_EXR_DEPTH = re.compile(r"(.*[.])?(z|depth|depth[.]v|y|v|r)", re.IGNORECASE)
"""Channels of Blender, Nuke, grey images and Record3D."""


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
    return decoded(content_of(path, MAX_BYTES), path, cv2.IMREAD_UNCHANGED)


def _array(path: Path) -> np.ndarray:
    """Return the array of an `.npy` file; pickles are not opened, and the declared size is checked first."""
    content = content_of(path, MAX_BYTES)
    try:
        stream = io.BytesIO(content)
        header = array_header(stream)
        if header.bytes != len(content) - stream.tell():
            raise ValueError(f"it declares {header.bytes} bytes and has {len(content) - stream.tell()}")
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))
    except UNREADABLE as error:
        raise InputError(f"`{path}` is not an array of NumPy that can be read: {error}") from None


def exr_depth(path: Path) -> np.ndarray:
    """Return the one channel that may be depth, float [H, W], as stored; read by OpenEXR (extra `phones`).

    Raises:
        InputError: OpenEXR is not installed, or the file is damaged, too large, or has no such channel, or several.

    """
    try:
        import OpenEXR
    except ImportError:
        raise InputError(f"`{path}` needs the package OpenEXR; {install_hint('phones')}") from None
    content_of(path, MAX_BYTES)  # OpenEXR names no reason
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        (left, top), (right, bottom) = header["dataWindow"]
        names = [channel.name for channel in header["channels"]]
        values = (int(right) - int(left) + 1) * (int(bottom) - int(top) + 1) * len(names)
        if not 0 < values <= MAX_PIXELS:  # all channels are decoded
            raise InputError(f"`{path}` declares {values} values; at most {MAX_PIXELS // 10**6} million are decoded")
        found = [name for name in names if _EXR_DEPTH.fullmatch(name)]
        if len(found) > 1:  # Blender writes colours, too: R, G, B beside Z
            found = [name for name in found if name.lower().endswith(("z", "depth", "depth.v"))] or found
        if len(found) != 1:
            raise InputError(f"`{path}` has the channels {', '.join(names)}; it must have one of Z, V, Y, R, depth")
        return np.asarray(OpenEXR.File(str(path), separate_channels=True).channels()[found[0]].pixels)
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise InputError(f"`{path}` cannot be decoded: {error}") from None
