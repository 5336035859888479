"""Key points of a frame that are found when somebody asks for them: most frames are followed without."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Self

from vggtgeo.models.roles import Features


class Description:
    """The key points and descriptors of one frame. Asked twice, they are found once."""

    def __init__(self, describe: Callable[[], Features]) -> None:
        self._describe = describe

    @classmethod
    def of(cls, features: Features) -> Self:
        """Of key points that are there already."""
        return cls(lambda: features)

    @cached_property
    def features(self) -> Features:
        """The key points; takes as long as the matcher's `describe` when it is first asked."""
        return self._describe()
