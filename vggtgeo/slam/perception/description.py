"""Description of a frame, computed on demand or ahead: most frames are tracked by optical flow, without key points."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Self

import numpy as np

from vggtgeo.models.roles import Features
from vggtgeo.slam.perception.rgbd_view import RgbdView


class Description:
    """Key points and descriptors of one frame, computed on first access, and its view for the alignment if it was
    computed ahead.
    """

    def __init__(
        self,
        describe: Callable[[], Features],
        view: RgbdView | None = None,
        intrinsics: np.ndarray | None = None,
    ) -> None:
        self._describe = describe
        self._view = view
        self._intrinsics = intrinsics

    @classmethod
    def of(cls, features: Features, view: RgbdView | None = None, intrinsics: np.ndarray | None = None) -> Self:
        """Return a description with known key points."""
        return cls(lambda: features, view, intrinsics)

    @cached_property
    def features(self) -> Features:
        """The key points; the first access takes as long as the matcher's `describe`."""
        return self._describe()

    @property
    def described(self) -> bool:
        """Whether the key points were computed."""
        return "features" in self.__dict__

    def view_by(self, intrinsics: np.ndarray) -> RgbdView | None:
        """Return the view if it was computed with these intrinsics, float64 [4], else None."""
        # Those of a known camera, weakly free, change by less than this tolerance.
        if self._intrinsics is None or not np.allclose(self._intrinsics, intrinsics):
            return None
        return self._view
