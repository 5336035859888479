"""Window adjustment in a thread beside tracking: it starts with a new keyframe and is merged a fixed number of frames
later.

The fixed number makes a run repeatable, whatever the speed of the machine. A new keyframe or a lost camera before that
merges it at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.state import PendingWindow, Slam

LAG = 6
"""Largest number of frames tracked meanwhile: matching and adjustment take as long as about five frames on two cores
(`benchmarks/stage_times.py`)."""


def begin_window(slam: Slam, adjusted: Callable[[], Slam]) -> Slam:
    """Return the state while `adjusted` is computed in a thread.

    slam: state with the new keyframe as tracked; tracking continues in it. adjusted: pure function that returns the
    state with the keyframe's matches and the adjusted window.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix="window")
    result = pool.submit(in_double_precision(adjusted))
    pool.shutdown(wait=False)
    return replace(slam, pending=PendingWindow(len(slam.frames) + 1 + LAG, slam, result))


def is_due(slam: Slam) -> bool:
    """Return whether the next frame is to be tracked in the adjusted map."""
    return slam.pending is not None and len(slam.frames) >= slam.pending.due


def merge_pending_window(slam: Slam) -> Slam:
    """Wait for the pending window and merge it.

    Keyframes, matches and window are from its thread; frames, factors and notes added since it began from tracking. For
    frames before it began, the thread's records are used.
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
