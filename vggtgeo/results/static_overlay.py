"""Search for a static overlay (bars, a watermark, dirt on the lens): before the run where frames can be read twice,
after the last frame where they are a stream.
"""

from __future__ import annotations

import warnings

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.io.errors import InputWarning
from vggtgeo.results.source import Source
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.perception.still_parts import (
    APART,
    PICTURES,
    StillParts,
    find_still_parts,
    small_grey,
    still_parts_of,
)
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.finding import Finding
from vggtgeo.slam.verdict.input import check_still_parts


class StaticOverlaySearch(Callback):
    """Finds the static overlay of a run's images, and gives the verdict its findings.

    found: the mask to leave out of perception; None before `search`, and where no overlay is certain.
    """

    def __init__(self) -> None:
        self.found: StillParts | None = None
        self._overlay: StillParts | None = None
        self._searched = False
        self._images: list[np.ndarray] = []
        self._size = (0, 0)
        self._stride = 1
        self._frames = 0

    def search(self, source: Source, selection: tuple[int, int | None, int]) -> None:
        """Search in a sample of the first frames, before the run; warn where an overlay is left out."""
        self._searched = True
        self._overlay = find_still_parts(source.sample_images(*selection, PICTURES, APART))
        if self._overlay is None or not self._overlay.separable:
            return
        self.found = self._overlay
        warnings.warn(
            f"{100 * self.found.share:.1f} % of the image is a static overlay (bars, a watermark, something on the "
            "lens?); features and depth there are ignored",
            InputWarning,
            stacklevel=4,
        )

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Keep 20 to 40 images, evenly spread over at most the first `PICTURES * APART` frames."""
        if self._searched or self._frames >= PICTURES * APART:
            return
        if self._frames % self._stride == 0:
            self._size = frame.image.shape[1], frame.image.shape[0]
            self._images.append(small_grey(frame.image))
            if len(self._images) == 2 * PICTURES:
                self._images, self._stride = self._images[::2], 2 * self._stride
        self._frames += 1

    def findings(self) -> tuple[Finding, ...]:
        """Return the findings for the verdict, after the last frame."""
        if not self._searched:
            self._overlay = still_parts_of(self._images, self._size)
        return check_still_parts(self._overlay, left_out=self.found is not None)
