"""Depth in EXR files of renderers and of the app Record3D, read by OpenEXR (extra `phones`)."""

import os
import re
from pathlib import Path

import numpy as np

from vggtgeo.datasets.image_checks import MAX_PIXELS
from vggtgeo.io.errors import InputError
from vggtgeo.models.extras import install_hint

_DEPTH = re.compile(r"(.*[.])?(z|depth|depth[.]v|y|v|r)", re.IGNORECASE)
"""Channels of Blender, Nuke, grey images and Record3D."""


def exr_depth(path: Path) -> np.ndarray:
    """Return the one channel that may be depth, float [H, W], as stored.

    Raises:
        InputError: OpenEXR is not installed, or the file is damaged, too large, or has no such channel, or several.

    """
    try:
        import OpenEXR
    except ImportError:
        raise InputError(f"`{path}` needs the package OpenEXR; {install_hint('phones')}") from None
    if not os.path.isfile(path):  # also False for names that the file system does not accept
        raise InputError(f"`{path}` cannot be read: no such file")
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        (left, top), (right, bottom) = header["dataWindow"]
        width, height = int(right) - int(left) + 1, int(bottom) - int(top) + 1
        names = [channel.name for channel in header["channels"]]
        if not 0 < width * height * len(names) <= MAX_PIXELS:  # all channels are decoded
            size = f"{width} x {height} pixels in {len(names)} channels"
            raise InputError(f"`{path}` declares {size}; it must be 1 to {MAX_PIXELS // 10**6} million values")
        found = [name for name in names if _DEPTH.fullmatch(name)]
        if len(found) > 1:  # Blender writes colours, too: R, G, B beside Z
            found = [name for name in found if name.lower().endswith(("z", "depth", "depth.v"))] or found
        if len(found) != 1:
            raise InputError(
                f"`{path}` has the channels {', '.join(names) or 'none'}; it must have one of Z, V, Y, R, depth"
            )
        pixels = OpenEXR.File(str(path), separate_channels=True).channels()[found[0]].pixels
    except (RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise InputError(f"`{path}` cannot be decoded: {error}") from None
    if not isinstance(pixels, np.ndarray) or pixels.shape != (height, width):
        raise InputError(f"`{path}` cannot be decoded: its channel {found[0]} is not {width} x {height} pixels")
    return pixels
