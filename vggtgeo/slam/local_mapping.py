"""Steps of the whole state that change its window: insert a keyframe, adjust, and adjust in a thread beside tracking.

The adjustment beside tracking starts with a new keyframe and is merged a fixed number of frames later. So a run is
repeatable, whatever the speed of the machine. A new keyframe or a lost camera before that merges it at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.models.classical import can_search
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.covisibility import match_keyframes
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import submap_of
from vggtgeo.slam.state import PendingWindow, Slam
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.window.adjustment import CameraPrior, write_back
from vggtgeo.slam.window.gauge import gauge_notes
from vggtgeo.slam.window.line_triangulation import with_segment_depths
from vggtgeo.slam.window.sliding_window import (
    marginalise_oldest,
    solve_jit,
    window_edges,
    window_problem,
    window_solver,
)

LAG = 6
"""Largest number of frames tracked meanwhile: matching and adjustment take as long as about five frames on two cores
(`benchmarks/stage_times.py`)."""
NEIGHBOURS = 3
"""Keyframes before and after an old one that make up the window when the camera comes back to it."""


def insert_keyframe(
    slam: Slam,
    keyframe: Keyframe,
    roles: Roles,
    settings: SlamSettings,
    tied_to: int | None = None,
    *,
    length_known: bool = True,
) -> Slam:
    """Insert a keyframe, which was tracked against `tied_to`, into the window and match it to the others.

    Images of keyframes outside the window are compressed. length_known: whether the distance to `tied_to` is measured.
    """
    window = marginalise_oldest(slam.window, settings, tied_to)
    match = lambda number: match_keyframes(
        slam.keyframes[number], keyframe, roles, slam.intrinsics, length_known=length_known
    )
    matched = map_in_threads(match, window.members, alone=not can_search(keyframe.features))
    pairs = tuple(pair for pair in matched if pair is not None)
    members = (*window.members, keyframe.number)
    # Members are read at every adjustment; decoding them each time would cost more than the memory is worth.
    kept = tuple(k.expanded() if k.number in members else k.compressed() for k in slam.keyframes)
    known = replace(slam.map, keyframes=(*kept, keyframe), pairs=(*slam.map.pairs, *pairs))
    return replace(slam, map=known, window=replace(window, members=members))


def adjust_window(slam: Slam, settings: SlamSettings) -> Slam:
    """Bundle-adjust the window of the state: its keyframes and intrinsics."""
    known, window = slam.map, slam.window
    keyframes = list(known.keyframes)
    # With measured depth, what a depth camera leaves out is glass, mirrors or far away: it is not triangulated.
    if not known.metric:
        members = {number: keyframes[number] for number in window.members}
        for number, own in with_segment_depths(members, window_edges(known, members), slam.intrinsics).items():
            keyframes[number] = own
        known = replace(known, keyframes=tuple(keyframes))
    adjustment, gauge = window_problem(known, window, slam.intrinsics, camera_prior(slam), settings)
    slam = slam.with_notes(*gauge_notes(gauge, adjustment.keyframes, "window"))
    solution = solve_jit(adjustment.problem, adjustment.initial, window_solver())
    # The keyframes before the solve are still valid: go on with them, and report.
    if not np.isfinite(float(solution.energy)):
        failure = f"window at keyframe {window.members[-1]}: {solution.message}"
        return replace(slam, map=known).with_notes(failure)
    updated, intrinsics = write_back([keyframes[number] for number in window.members], adjustment, solution.state)
    for own in updated:
        keyframes[own.number] = own
    history = np.asarray(solution.history, np.float64)
    adjusted = slam.with_map(keyframes=tuple(keyframes)).with_camera(intrinsics=intrinsics)
    return adjusted.with_window(
        solved=(adjustment, solution.state), energies=history[np.isfinite(history)], iterations=solution.record
    )


def camera_prior(slam: Slam) -> CameraPrior:
    """Return the prior of the intrinsics in the window."""
    return CameraPrior(slam.camera.given, slam.camera.window_sigma(len(slam.keyframes)))


def window_around(slam: Slam, number: int, settings: SlamSettings) -> Slam:
    """Return a window of the keyframes around an old one, which is fixed: the camera has come back to it.

    Only of its own submap: the pose of another one is a guess, so matches predicted from it would be wrong.
    """
    label = submap_of(slam.map)
    around = range(max(number - NEIGHBOURS, 0), min(number + NEIGHBOURS + 1, len(slam.keyframes)))
    own = sorted((other for other in around if label[other] == label[number]), key=lambda other: abs(other - number))
    window = tuple(sorted(own[: settings.window.size - 1]))
    # Without metric depth one fixed pose leaves the scale free: two fix it.
    fixed = (number,) if slam.metric else tuple(member for member in window if abs(member - number) <= 1)
    return slam.with_window(members=window, prior=None, solved=None, fixed=fixed)


def begin_window(slam: Slam, adjusted: Callable[[], Slam]) -> Slam:
    """Return the state while `adjusted` is computed in a thread.

    slam: state with the new keyframe as tracked; tracking continues in it. adjusted: pure function that returns the
    state with the keyframe's matches and the adjusted window.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix="window")
    result = pool.submit(in_double_precision(adjusted))
    pool.shutdown(wait=False)
    # The caller adds the new keyframe's own frame after this, hence 1.
    return replace(slam, pending=PendingWindow(len(slam.frames) + 1 + LAG, slam, result))


def is_due(slam: Slam) -> bool:
    """Return whether the next frame is to be tracked in the adjusted map."""
    return slam.pending is not None and len(slam.frames) >= slam.pending.due


def merge_pending_window(slam: Slam) -> Slam:
    """Wait for the pending window and merge it.

    Keyframes, matches, camera, window, and the records of frames before it began are from its thread. Velocity, lost
    count, and the frames, factors and notes added since then are from tracking.
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
