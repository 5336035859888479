"""The search for what stays in its place in the picture: before the first frame where frames can be looked at twice,
after the last one where they come once.
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
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.input import check_still_parts


class StillSearch(Callback):
    """Finds the still parts of a run's pictures, and says what the verdict should know of them.

    found: what there is to leave out, None before `look` and where nothing is sure enough.
    """

    def __init__(self) -> None:
        self.found: StillParts | None = None
        self._seen: StillParts | None = None
        self._looked = False
        self._pictures: list[np.ndarray] = []
        self._size = (0, 0)
        self._stride = 1
        self._frames = 0

    def look(self, source: Source, selection: tuple[int, int | None, int]) -> None:
        """At some of the first frames, before the run."""
        self._looked = True
        self._seen = find_still_parts(source.some_pictures(*selection, PICTURES, APART))
        if self._seen is None or not self._seen.separable:
            return
        self.found = self._seen
        warnings.warn(
            f"{100 * self.found.share:.1f} % of the picture stays in its place while the rest moves (bars, a "
            "watermark, something on the lens?): nothing is looked for there",
            InputWarning,
            stacklevel=4,
        )

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Keep 20 to 40 pictures, evenly spread over at most the first `PICTURES * APART` frames."""
        if self._looked or self._frames >= PICTURES * APART:
            return
        if self._frames % self._stride == 0:
            self._size = frame.image.shape[1], frame.image.shape[0]
            self._pictures.append(small_grey(frame.image))
            if len(self._pictures) == 2 * PICTURES:
                self._pictures, self._stride = self._pictures[::2], 2 * self._stride
        self._frames += 1

    def findings(self) -> tuple[Finding, ...]:
        """After the last frame."""
        if not self._looked:
            self._seen = still_parts_of(self._pictures, self._size)
        return check_still_parts(self._seen, left_out=self.found is not None)
