"""The submaps of a run by size, and the stretches of frames without a pose."""

from __future__ import annotations

import numpy as np

from vggtgeo.slam.sparse_map.map import submap_of
from vggtgeo.slam.state import Slam


def submaps_by_size(slam: Slam) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of the keyframes of each submap, first of the one with the most frames."""
    if not slam.keyframes:
        return ()
    label = submap_of(slam.map)
    hanging = np.bincount(label[[r.reference for r in slam.frames if r.tracked]], minlength=label.max(initial=-1) + 1)
    order = np.argsort(-hanging, kind="stable")
    return tuple(tuple(int(number) for number in np.nonzero(label == submap)[0]) for submap in order)


def lost_stretches(slam: Slam) -> tuple[tuple[int, int], ...]:
    """Return the first and last row of `slam.frames` of each stretch of frames without a pose."""
    return stretches(np.array([not record.tracked for record in slam.frames], bool))


def stretches(marked: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Return the first and last row of each run of True values of bool [n]."""
    first, past = np.flatnonzero(np.diff(np.r_[False, marked, False])).reshape(-1, 2).T
    return tuple((int(i), int(j) - 1) for i, j in zip(first, past, strict=True))
