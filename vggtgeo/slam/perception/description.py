"""What is made of a frame before it is tracked, or when somebody asks: most frames are followed without key points."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Self

import numpy as np

from vggtgeo.models.roles import Features
from vggtgeo.slam.perception.rgbd_view import RgbdView

SAME_CAMERA = 1e-3
"""Pixels: intrinsics that differ by less make the same view. Those of a known camera, held, move by a part of it."""


class Description:
    """The key points and descriptors of one frame, found when they are first asked for; and, where it was made while
    earlier frames were tracked, its view for the alignment.
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
        """Of key points that are there already."""
        return cls(lambda: features, view, intrinsics)

    @cached_property
    def features(self) -> Features:
        """The key points; takes as long as the matcher's `describe` when it is first asked."""
        return self._describe()

    @property
    def described(self) -> bool:
        """Whether somebody has asked for the key points."""
        return "features" in self.__dict__

    def view_by(self, intrinsics: np.ndarray) -> RgbdView | None:
        """The view, if there is one that was made with these intrinsics, float64 [4]."""
        if self._intrinsics is None or np.abs(self._intrinsics - intrinsics).max() > SAME_CAMERA:
            return None
        return self._view
