"""Seeds for robust estimation: the order in which matches are passed to a sampler.

OpenCV's samplers (USAC) have a generator that starts in the same state at every call, independent of `setRNGSeed`.
Another order of the matches gives other samples.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

Role = TypeVar("Role")


@dataclass(frozen=True)
class SampleOrder:
    """Order of matches by a seed; 0 keeps the given order.

    Example:
        >>> from vggtgeo.models.classical import SampleOrder
        >>> SampleOrder().of(3).tolist(), SampleOrder(1).of(3).tolist()
        ([0, 1, 2], [2, 0, 1])

    """

    seed: int = 0

    def of(self, count: int) -> np.ndarray:
        """Return a permutation of `count` matches, int [count]."""
        if self.seed == 0:
            return np.arange(count)
        return np.random.default_rng(self.seed).permutation(count)

    def undone(self, values: np.ndarray) -> np.ndarray:
        """Return values [count] from this order in the given order."""
        own = np.empty_like(values)
        own[self.of(len(values))] = values
        return own


def in_order(role: Role, order: SampleOrder) -> Role:
    """Return a role, with all its parts, with another order of samples."""
    if isinstance(role, SampleOrder):
        changed: Any = order
        return changed
    if not is_dataclass(role) or isinstance(role, type):
        return role
    members = {field.name: getattr(role, field.name) for field in fields(role) if field.init}
    new = {name: made for name, value in members.items() if (made := in_order(value, order)) is not value}
    return replace(role, **new) if new else role
