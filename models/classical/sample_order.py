"""What a seed changes of robust estimation: the order in which matches are given to a sampler.

OpenCV's samplers (USAC) draw from a generator that begins in the same state at every call, whatever `setRNGSeed` says,
so a run is repeatable; in another order of the matches they draw other samples.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

Role = TypeVar("Role")


@dataclass(frozen=True)
class SampleOrder:
    """The order of matches by a seed; 0 leaves them as they are found.

    Example:
        >>> from vggtgeo.models.classical import SampleOrder
        >>> SampleOrder().of(3).tolist(), SampleOrder(1).of(3).tolist()
        ([0, 1, 2], [2, 0, 1])

    """

    seed: int = 0

    def of(self, count: int) -> np.ndarray:
        """A permutation of `count` matches, int [count]."""
        if self.seed == 0:
            return np.arange(count)
        return np.random.default_rng(self.seed).permutation(count)

    def undone(self, values: np.ndarray) -> np.ndarray:
        """Values [count] of the matches in this order, in their own."""
        own = np.empty_like(values)
        own[self.of(len(values))] = values
        return own


def in_order(role: Role, order: SampleOrder) -> Role:
    """A role, and all that it is made of, with another order of samples."""
    if isinstance(role, SampleOrder):
        changed: Any = order
        return changed
    if not is_dataclass(role) or isinstance(role, type):
        return role
    members = {field.name: getattr(role, field.name) for field in fields(role) if field.init}
    new = {name: made for name, value in members.items() if (made := in_order(value, order)) is not value}
    return replace(role, **new) if new else role
