"""A window's adjustment beside tracking: begun with its newest keyframe, taken up a fixed number of frames later.

A fixed number, and not as soon as it is done: so a run is repeatable, however fast the machine. Where the next keyframe
comes before, or the camera is lost, the state takes it up at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.state import PendingWindow, Slam

LAG = 6
"""Frames that are tracked meanwhile, at most: a keyframe's matching and adjustment take as long as five, on two cores
(on redkitchen 0.28 s, a frame beside them 0.06 s)."""


def begin_window(slam: Slam, adjusted: Callable[[], Slam]) -> Slam:
    """The state while `adjusted` is computed in a thread of its own.

    slam: has the newest keyframe as it was tracked, and is tracked in meanwhile. adjusted: the state with its matches
    and the adjusted window; a pure function.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix="window")
    result = pool.submit(in_double_precision(adjusted))
    pool.shutdown(wait=False)
    return replace(slam, pending=PendingWindow(len(slam.frames) + 1 + LAG, slam, result))


def is_due(slam: Slam) -> bool:
    """Whether the next frame is to be tracked in the adjusted map."""
    return slam.pending is not None and len(slam.frames) >= slam.pending.due


def settled(slam: Slam) -> Slam:
    """The state with the window that was pending; waits for it. What tracking has noted since is kept, and what the
    other thread has found of the frames before.
    """
    if slam.pending is None:
        return slam
    begun, found = slam.pending.begun, slam.pending.result.result()
    since = slam.tracker.frames[len(found.frames) :]
    factors = slam.map.factors[len(begun.map.factors) :]
    return replace(
        found,
        map=replace(found.map, factors=(*found.map.factors, *factors)),
        tracker=replace(slam.tracker, frames=(*found.frames, *since)),
        notes=(*found.notes, *slam.notes[len(begun.notes) :]),
    )
