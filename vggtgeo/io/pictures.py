"""Write image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from vggtgeo.io.files import atomic_open


def write_picture(path: Path, image: np.ndarray, options: Sequence[int] = ()) -> None:
    """Write `image` [H, W] or [H, W, 3] (BGR) atomically, in the format of the suffix of `path`; options: of OpenCV."""
    # Encoded first: OpenCV does not report a full disk, and leaves a part of an image.
    with atomic_open(path, "wb") as file:
        file.write(cv2.imencode(path.suffix, image, options)[1].tobytes())
