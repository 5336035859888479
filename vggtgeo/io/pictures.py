"""Images as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from vggtgeo.io.files import atomic_open


def write_picture(path: Path, image: np.ndarray, options: Sequence[int] = ()) -> None:
    """Writes `image` [H, W] or, in the order blue, green, red, [H, W, 3], atomically, in the format that the suffix of
    `path` names. options: OpenCV's.
    """
    # Encoded first: OpenCV's own writing of a file does not tell that a disk is full, and leaves a part of an image.
    with atomic_open(path, "wb") as file:
        file.write(cv2.imencode(path.suffix, image, options)[1].tobytes())
