"""Colours of points and surfaces in the colour space of each format.

The run's colours are those of the pictures: sRGB (IEC 61966-2-1), 8 bits.

| format | what it says of its colours | written |
|---|---|---|
| glTF, `COLOR_0` | linear factors (glTF 2.0, 3.9.2); 8 bits of that lose dark tones | linear, 16 bits |
| PLY; points of nerfstudio | nothing; readers show the bytes as those of a picture | sRGB, 8 bits |
| LAS | image channels of 16 bits (LAS 1.4, 2.6.8), shown as those of a picture | sRGB, 16 bits |
| COLMAP | the bytes of the pictures | sRGB, 8 bits |
| Rerun | sRGB (`rerun.components.Color`) | sRGB, 8 bits |
"""

import numpy as np
from jaxtyping import UInt8, UInt16

FULL_SCALE = 65535
_WIDER = FULL_SCALE // 255
_LINEAR_BELOW, _SLOPE, _OFFSET, _GAMMA = 0.04045, 12.92, 0.055, 2.4
"""Of the transfer function of sRGB."""


def srgb_16_bits(colours: UInt8[np.ndarray, "n 3"]) -> UInt16[np.ndarray, "n 3"]:
    """The same sRGB colours in 16 bits, for LAS."""
    return colours.astype(np.uint16) * _WIDER


def linear_16_bits(colours: UInt8[np.ndarray, "n 3"]) -> UInt16[np.ndarray, "n 3"]:
    """Linear light of sRGB colours, `FULL_SCALE` for 1, for glTF."""
    codes = np.arange(256) / 255.0
    linear = np.where(codes <= _LINEAR_BELOW, codes / _SLOPE, ((codes + _OFFSET) / (1.0 + _OFFSET)) ** _GAMMA)
    return np.rint(FULL_SCALE * linear).astype(np.uint16)[colours]
