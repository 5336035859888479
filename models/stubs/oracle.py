"""What a stub may ask: the truth about the images of a synthetic scene."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np


class VisibleSegments(Protocol):
    """Visible straight edges. pixels: float [L, 2, 2] (segment, end, xy). contrast: float [L], grey levels a pixel."""

    @property
    def pixels(self) -> np.ndarray: ...

    @property
    def contrast(self) -> np.ndarray: ...


@runtime_checkable
class Oracle(Protocol):
    """Knows each image that its scene has given. `index` is the frame's number."""

    @property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy, float [4], pixels."""
        ...

    def index_of(self, image: np.ndarray) -> int:
        """Return the frame whose image this is; raises ValueError for any other image."""
        ...

    def timestamp(self, index: int) -> float:
        """Seconds."""
        ...

    def pose(self, index: int) -> np.ndarray:
        """Return world -> camera, float [4, 4]."""
        ...

    def depth(self, index: int) -> np.ndarray:
        """Return float [H, W], metres, NaN = none."""
        ...

    def glass(self, index: int) -> np.ndarray:
        """Return bool [H, W], pixels seen through glass."""
        ...

    def texture(self, index: int) -> np.ndarray:
        """Return float [H, W] in [0, 1), strength of texture."""
        ...

    def edges(self, index: int) -> Any:
        """`VisibleSegments` of the frame."""
        ...

    def correspond(self, index_i: int, index_j: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where pixels [n, 2] of frame i are in frame j, float [n, 2], and whether they are seen there, bool
        [n].
        """
        ...
